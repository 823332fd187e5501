"""What follows a failed step: try again, ask a person, or stop the run; and every question about a step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import StrEnum

from brushloop.calibrate.board.pix2len import WORST_RMS_PX
from brushloop.collect.errors import BadPicture, ForceTooHigh, NeedsOperator, SheetFull, StepError, StepVoid, describe
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.protocols.steps import Step
from brushloop.collect.rig.config import RigConfig
from brushloop.drivers.errors import (
    ArmMoved,
    DeviceError,
    DeviceTimeout,
    MotionError,
    NotPowered,
    PathDisturbed,
    RobotNotSafe,
    SettingsChanged,
    Stuck,
)
from brushloop.drivers.ink.port import DoseLost, InkRefused
from brushloop.sessions.events import BoardResult, SelfCheckResult, StepKind, StepResult, ZeroTouchResult

MAX_FAILURES = 3
"""Failures of one step after which a person decides: so many are no coincidence."""

STOP = Choice("x", "stop the run")
GO_ON = "g"


class Action(StrEnum):
    """What the engine does next."""

    RETRY = "again"
    """Retreat, then do the step again; a press takes a new patch."""
    ASK = "ask"
    """Let a person decide; if nobody watches, stop the run."""
    ABORT = "stop the run"
    """Leave the session open; the same command resumes from there."""


def decide(step: Step, error: StepError | DeviceError, failures: int) -> Action:
    """Return the action for the `failures`-th failure of `step`. Motion is never blindly repeated."""
    again = Action.RETRY if failures < MAX_FAILURES else Action.ASK
    match step.kind, error:
        # Only a person can change paper or ink, mend a sensor, release the arm, or see what lies under the brush.
        case _, SheetFull() | NeedsOperator() | ForceTooHigh() | InkRefused() | DoseLost() | RobotNotSafe() | Stuck():
            return Action.ASK
        # Somebody else had the arm.
        case _, ArmMoved() | SettingsChanged() | NotPowered() | PathDisturbed():
            return Action.ASK
        # If the arm was stopped because the sensor fell silent, and it still is, the next press fails at once.
        case StepKind.PRESS, StepVoid() | DeviceTimeout(device="force"):
            return again
        case StepKind.PRESS | StepKind.SELF_CHECK, BadPicture():
            return Action.ASK  # another try would use up another patch
        case _, BadPicture():
            return again
        case StepKind.CAPTURE | StepKind.BOARD, DeviceTimeout(device="camera"):
            return again
        case _:
            return Action.ABORT


def question(error: StepError | DeviceError, sheet: int) -> Prompt:
    """The question that `error` leads to, while sheet `sheet` (from 0) is in. The default is always to stop: nothing
    moves without an answer."""
    text = describe(error)
    match error:
        case SheetFull():
            text = f"Sheet {sheet + 1} is full. Put a fresh sheet in, then go on."
            go_on = f"sheet {sheet + 2} is in, and blank"
        case InkRefused():
            go_on = "there is ink in the well: dip again"
        case ForceTooHigh():
            go_on = "nothing is under the brush: lift the brush and go on"
        case ArmMoved() | PathDisturbed():
            go_on = "nobody else uses the arm: lift the brush and go on"
        case SettingsChanged():
            go_on = "nobody else uses the arm: restore the settings, lift the brush and go on"
        case NotPowered():
            go_on = "nothing is in the way of the arm: power it, lift the brush and go on"
        case MotionError():
            go_on = "the arm is released and nothing is in its way: lift the brush and go on"
        case _:
            go_on = "the cause is removed: try again"
    return Prompt(text, (Choice(GO_ON, go_on), STOP), STOP.key)


AGAIN = Choice("a", "measure again")
BY_JOG, BY_FORCE = Choice("b", "measure by jog"), Choice("f", "measure by force")
METHODS = {BY_JOG.key: "jog", BY_FORCE.key: "force"}
TITLES = {
    StepKind.BOARD: "Camera, board, scale",
    StepKind.ZERO_TOUCH: "Zero touch and plane",
    StepKind.SELF_CHECK: "Self-check",
}
"""Steps of the set-up, in their order; the board is also looked at, and the paper found, between strokes."""
NAME, SIGNS = 20, {True: "✓", False: "!", None: " "}
"""Columns of a fact's name; what stands before it if it is within its limit, if not, and if it has none."""


Fact = tuple[str, str, bool | None]
"""Name and value of what a set-up step measured, and whether it is within its limit; None without one."""


def accept_question(result: StepResult, config: RigConfig) -> Prompt:
    """Ask whether the result is good enough. The default is to stop: nothing goes on without an answer."""
    facts = list(_facts(result, config))
    good = all(within is not False for _name, _value, within in facts)
    verdict = f"{TITLES[result.kind]}: " + ("all within limits." if good else "not everything is within limits.")
    lines = [f"{SIGNS[within]} {name:<{NAME}} {value}" for name, value, within in facts]
    choices = [Choice(GO_ON, "good, go on" if good else "go on anyway"), AGAIN]
    if isinstance(result, ZeroTouchResult):
        choices += [BY_JOG, *([BY_FORCE] if config.force is not None else [])]
    return Prompt("\n".join([verdict, *lines]), (*choices, STOP), STOP.key)


def _within(name: str, value: float, limit: float, shown: str) -> Fact:
    """A value that may be at most `limit` to either side of zero."""
    return name, f"{shown}  (at most {limit:g})", abs(value) <= limit


def _facts(result: StepResult, config: RigConfig) -> Iterator[Fact]:
    """What a step of the set-up measured; nothing of other steps."""
    match result:
        case BoardResult(camera_delay_ms=delay_ms, camera_jitter_ms=jitter_ms):
            yield "corners found", str(result.corners), None
            yield "scale (pix2len)", f"{result.mm_per_px:.4f} mm/px", None
            yield _within("residual of corners", result.rms_px, WORST_RMS_PX, f"{result.rms_px:.2f} px")
            if delay_ms is not None and jitter_ms is not None:
                yield _within("delay of the camera", delay_ms, config.camera.max_delay_ms, f"{delay_ms:.0f} ms")
                yield _within("the delay varies by", jitter_ms, config.camera.max_jitter_ms, f"{jitter_ms:.0f} ms")
            for check in result.checks:
                name = {"blurred": "blur of edges", "exposure": "paper's brightness"}.get(check.name, check.name)
                yield name, f"{check.score:.3g} {check.unit}  (limit {check.threshold:g})", check.passed
        case ZeroTouchResult(method=method, points=points):
            touch, taught = config.touch, method == "taught"
            yield "method", "the taught height" if taught else method, None
            for number, point in enumerate(points, 1):
                where = f"point {number} ({point.x_mm:.0f}, {point.y_mm:.0f})"
                yield where, f"{point.z_mm:.3f} mm", None
                if not taught:
                    span_mm = point.span_mm
                    yield _within("  span of touches", span_mm, touch.repeatability_mm, f"{span_mm:.3f} mm")
            if not taught:
                yield _within("from the last height", result.moved_mm, touch.moved_mm, f"{result.moved_mm:+.3f} mm")
            off_mm = [abs(residual_mm) for residual_mm in result.residuals_mm]
            if len(off_mm) > 3:
                yield _within("distance from plane", max(off_mm), touch.residual_mm, f"{max(off_mm):.3f} mm")
            level = "assumed level: fewer than three points"
            yield "plane", level if len(off_mm) < 3 else f"leans by {result.slope_deg:.2f}°", None
        case SelfCheckResult(turn_deg=turn_deg):
            off_mm = math.hypot(*result.offset_mm)
            scale_x, scale_y = (100.0 * (scale - 1.0) for scale in result.scale)
            yield _within("offset of the marks", off_mm, config.self_check.offset_mm, f"{off_mm:.2f} mm")
            yield _within("turn of the marks", turn_deg, config.self_check.turn_deg, f"{turn_deg:+.2f}°")
            yield "error of lengths", f"{scale_x:+.2f} % in x, {scale_y:+.2f} % in y", None
            yield "largest residual", f"{max(result.residuals_mm):.2f} mm", None
        case _:
            pass
