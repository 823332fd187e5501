"""Compares what a set-up step measured with its limits, and asks the questions of a guided set-up."""

from __future__ import annotations

from dataclasses import replace

from brushloop.calibrate.board.pix2len import WORST_RMS_PX
from brushloop.collect.engine.policy import GO_ON, KEEP, STOP
from brushloop.collect.engine.snapshot import SET_UP, TITLES, Fact, SetUpStep, Standing
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.protocols.steps import Protocol, Result, Step, StepKind
from brushloop.collect.rig.config import RigConfig

AGAIN = Choice("a", "measure again")
BY_JOG, BY_FORCE = Choice("b", "measure by jog"), Choice("f", "measure by force")
METHODS = {BY_JOG.key: "jog", BY_FORCE.key: "force", KEEP: "kept"}


def facts_of(kind: StepKind, result: Result, config: RigConfig) -> tuple[Fact, ...]:
    """What a finished set-up step measured, from its result in the journal."""
    match kind:
        case StepKind.BOARD:
            return _board(result, config)
        case StepKind.ZERO_TOUCH:
            return _touch(result, config)
        case StepKind.SELF_CHECK:
            return _self_check(result, config)
        case _:
            return ()


def listed(
    config: RigConfig, found: dict[StepKind, Result], now: StepKind | None, *, checked: bool
) -> tuple[SetUpStep, ...]:
    """Every set-up step of this run, with what was measured so far; `now` is in progress. `checked`: it has a
    self-check."""
    kinds = SET_UP if checked else SET_UP[:-1]
    return tuple(_listed(kind, found.get(kind), config, now is kind) for kind in kinds)


def question(kind: StepKind, result: Result, config: RigConfig) -> Prompt:
    """Ask whether the result is good enough. The default is to stop: nothing goes on without an answer."""
    facts = facts_of(kind, result, config)
    good = all(fact.good is not False for fact in facts)
    text = f"{TITLES[kind]}: " + ("all within limits." if good else "not all is within limits.")
    choices = [Choice(GO_ON, "good, go on" if good else "go on anyway"), AGAIN]
    if kind is StepKind.ZERO_TOUCH:
        choices += [BY_JOG, *([BY_FORCE] if config.force is not None else [])]
    return Prompt(text, (*choices, STOP), STOP.key)


def again(step: Step, answer: str) -> Step:
    """Return the same step, with the method that the answer names, if any."""
    return replace(step, params={**step.params, "method": METHODS[answer]}) if answer in METHODS else step


def board_first(protocol: Protocol) -> Protocol:
    """Yield a board step, then the same steps, so that the board is seen before the brush comes down. Both board steps
    have the same key, so the later one is then done already."""
    yield Step(StepKind.BOARD, 0)
    yield from protocol


def _listed(kind: StepKind, result: Result | None, config: RigConfig, now: bool) -> SetUpStep:
    facts = () if result is None else facts_of(kind, result, config)
    if now:
        return SetUpStep(kind, Standing.NOW, facts)
    if result is None:
        return SetUpStep(kind, Standing.TO_COME)
    good = all(fact.good is not False for fact in facts)
    return SetUpStep(kind, Standing.GOOD if good else Standing.DOUBTFUL, facts)


def _board(result: Result, config: RigConfig) -> tuple[Fact, ...]:
    facts = [
        Fact("corners seen", str(result["corners"])),
        Fact("scale (pix2len)", f"{result['mm_per_px']:.4f} mm/px"),
    ]
    if "rms_px" in result:
        rms_px = float(result["rms_px"])
        facts.append(
            Fact("residual of corners", f"{rms_px:.2f} px", f"at most {WORST_RMS_PX:g}", rms_px <= WORST_RMS_PX)
        )
    if "camera_delay_ms" in result:
        for name, value_ms, limit_ms in (
            ("delay of the camera", float(result["camera_delay_ms"]), config.camera.max_delay_ms),
            ("variation of the delay", float(result["camera_jitter_ms"]), config.camera.max_jitter_ms),
        ):
            facts.append(Fact(name, f"{value_ms:.0f} ms", f"at most {limit_ms:g}", value_ms <= limit_ms))
    for check in result.get("checks", ()):
        name, score = str(check["name"]), float(check["score"])
        if name == "blurred":
            facts.append(
                Fact("focus: blur", f"{score:.2f} mm", f"at most {check['threshold']:g}", bool(check["passed"]))
            )
        elif name == "exposure":
            facts.append(Fact("light: paper", f"level {score:.0f}", "", bool(check["passed"])))
    return tuple(facts)


def _touch(result: Result, config: RigConfig) -> tuple[Fact, ...]:
    touch, method = config.touch, str(result["method"])
    named = {"taught": "taught height, visited", "kept": "none: the previous height is kept"}
    facts = [Fact("method", named.get(method, method))]
    for number, point in enumerate(result["points"], 1):
        where = f"point {number} ({point['x_mm']:.0f}, {point['y_mm']:.0f})"
        if method in named:
            facts.append(Fact(where, f"{'rests' if method == 'taught' else 'is'} at {point['z_mm']:.2f} mm"))
            continue
        span_mm, limit_mm = float(point["span_mm"]), touch.repeatability_mm
        facts.append(Fact(where, f"{point['z_mm']:.3f} mm", "", None))
        facts.append(Fact("  its touches span", f"{span_mm:.3f} mm", f"at most {limit_mm:g}", span_mm <= limit_mm))
    if method not in named and "moved_mm" in result:
        moved_mm = float(result["moved_mm"])
        near = abs(moved_mm) <= touch.moved_mm
        facts.append(Fact("from the height before", f"{moved_mm:+.3f} mm", f"at most {touch.moved_mm:g}", near))
    residuals = [abs(float(r)) for r in result["residuals_mm"]]
    if len(residuals) > 3:
        worst_mm = max(residuals)
        facts.append(
            Fact("off the plane", f"{worst_mm:.3f} mm", f"at most {touch.residual_mm:g}", worst_mm <= touch.residual_mm)
        )
    plane = "level: fewer than three points" if len(residuals) < 3 else f"leans by {float(result['slope_deg']):.2f}°"
    facts.append(Fact("plane", plane))
    return tuple(facts)


def _self_check(result: Result, config: RigConfig) -> tuple[Fact, ...]:
    limits = config.self_check
    x_mm, y_mm = (float(v) for v in result["offset_mm"])
    off_mm, turn_deg = (x_mm**2 + y_mm**2) ** 0.5, float(result["turn_deg"])
    scale_x, scale_y = (100.0 * (float(v) - 1.0) for v in result["scale"])
    worst_mm = max(float(v) for v in result["residuals_mm"])
    return (
        Fact("marks lie off by", f"{off_mm:.2f} mm", f"at most {limits.offset_mm:g}", off_mm <= limits.offset_mm),
        Fact("turned by", f"{turn_deg:+.2f}°", f"at most {limits.turn_deg:g}", abs(turn_deg) <= limits.turn_deg),
        Fact("lengths off by", f"{scale_x:+.2f} % in x, {scale_y:+.2f} % in y"),
        Fact("left over", f"{worst_mm:.2f} mm"),
    )
