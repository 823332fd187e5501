"""`adaptive`: presses chosen one by one. Which comes next is the result of a CHOOSE step, so a resume replays it."""

from __future__ import annotations

from dataclasses import replace

from collect.protocols.config import AdaptiveConfig
from collect.protocols.steps import Protocol, Result, Step, StepKind
from collect.protocols.strokes import Planned, takes


def cells(config: AdaptiveConfig) -> list[tuple[float, float]]:
    """(H, alpha) that can be chosen, in the order of the grid."""
    return [(h, a) for h in config.heights_mm for a in config.tilts_deg]


def planned(config: AdaptiveConfig) -> list[Planned]:
    """The worst case: as many presses as there may be, the cells in turn."""
    every = cells(config)
    return [_stroke(config, number, *every[number % len(every)]) for number in range(config.most)]


def steps(config: AdaptiveConfig) -> Protocol:
    """Zero touch, board, then choose, dip, press, capture, until the choice is to stop.

    A CHOOSE without an answer (a plan that is only walked) is the worst case.
    """
    yield Step(StepKind.ZERO_TOUCH, 0)
    yield Step(StepKind.BOARD, 0)
    for worst in planned(config):
        number = worst.index
        if config.board_every is not None and number > 0 and number % config.board_every == 0:
            yield Step(StepKind.BOARD, number // config.board_every)
        chosen = yield Step(StepKind.CHOOSE, number)
        if chosen.get("stop"):
            return
        cell = (worst.height_mm, worst.tilt_deg)
        if "height_mm" in chosen:
            cell = (float(chosen["height_mm"]), float(chosen["tilt_deg"]))
        yield from takes(_stroke(config, number, *cell), measured=True)
    yield Step(StepKind.CHOOSE, config.most, {"last": True})


def with_choice(plan: list[Planned], chosen: Result) -> list[Planned]:
    """The worst case `plan` after a CHOOSE step: its stroke is the chosen one, or nothing more is planned."""
    number = int(chosen["number"])
    if chosen["stop"]:
        return plan[:number]
    height_mm, tilt_deg = float(chosen["height_mm"]), float(chosen["tilt_deg"])
    name = _name(number, height_mm, tilt_deg)
    made = replace(plan[number], stroke_id=name, height_mm=height_mm, tilt_deg=tilt_deg)
    return [*plan[:number], made, *plan[number + 1 :]]


def _stroke(config: AdaptiveConfig, number: int, height_mm: float, tilt_deg: float) -> Planned:
    return Planned(_name(number, height_mm, tilt_deg), height_mm, tilt_deg, 1, number, dwell_s=config.dwell_s)


def _name(number: int, height_mm: float, tilt_deg: float) -> str:
    return f"{number + 1:03d}-H{height_mm:g}-a{tilt_deg:g}"
