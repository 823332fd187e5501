"""Walks a protocol as if every step succeeded: each step, its patch and its moves. Nothing connects, nothing moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from brushloop.collect.motion.moves import (
    Part,
    Room,
    commanded,
    inking_moves,
    mark_moves,
    over,
    photograph_moves,
    press_moves,
    stroke_moves,
    visit_moves,
    zero_touch_moves,
)
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.steps import (
    MARKING,
    BoardStep,
    CaptureStep,
    DipStep,
    Drawn,
    DrawStep,
    PressStep,
    Protocol,
    ReviewStep,
    SelfCheckStep,
    Step,
    TouchStep,
    ZeroTouchStep,
    with_self_check,
)
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.paper import Layout, PaperPlane, Patch, Sheet
from brushloop.collect.touch.heights import lowest_z_mm
from brushloop.collect.touch.places import patch_spots, touch_rects
from brushloop.collect.touch.selfcheck import partners, triangle_on
from brushloop.drivers.devices import Pose
from brushloop.sessions.events import PressResult, StepKind, StepResult


@dataclass(frozen=True, slots=True)
class StepMoves:
    """The moves of a step in order, and what else in it takes time or ink."""

    parts: list[Part] = field(default_factory=list[Part])
    dwell_s: float = 0.0
    captures: int = 0
    dips: int = 0

    @property
    def poses(self) -> list[tuple[Pose, float]]:
        """Every pose that is commanded, with its speed; of a `Room`, the outermost poses."""
        return commanded(self.parts)


def moves_of(
    config: RigConfig,
    plane: PaperPlane,
    step: Step,
    patch: Patch | None,
    more: tuple[Patch, ...] = (),
    *,
    dips: int = 0,
) -> StepMoves:
    """The moves of a step, as the run makes them.

    `patch` is where a press or a figure goes; `more` are the further patches of a self-check. `dips` is the number of
    dips before the step, which decides when the brush is washed.
    """
    match step:
        case ZeroTouchStep() | TouchStep():
            return _touches(config, plane, step, dips)
        case DipStep():
            return StepMoves([*inking_moves(config, dips)], dips=1)
        case ReviewStep():
            return StepMoves()
        case BoardStep():
            return StepMoves([*photograph_moves(config)], captures=1)
        case CaptureStep():
            return StepMoves([*photograph_moves(config), inking_moves(config, dips)[0]], captures=1)
        case PressStep(press=press, dwell_s=dwell_s):
            assert patch is not None
            down, up = press_moves(config, plane, patch, press.condition)
            return StepMoves([*down, *up], dwell_s=dwell_s)
        case SelfCheckStep():
            assert patch is not None
            moves = [
                move
                for number, place_mm in enumerate(triangle_on((patch, *more), config.self_check))
                for move in (*inking_moves(config, dips + number), *mark_moves(config, plane, *place_mm))
            ]
            return StepMoves([*photograph_moves(config), *moves, *photograph_moves(config)], dips=3, captures=2)
        case DrawStep(drawn=drawn):
            assert patch is not None
            return _figure(config, plane, drawn, patch, dips)


def touch_of(config: RigConfig, step: ZeroTouchStep | TouchStep) -> TouchConfig:
    """How and where a ZERO_TOUCH or TOUCH step touches. Raises ValueError for too few points for its method."""
    asked: dict[str, object] = {}
    if isinstance(step, TouchStep):
        asked["points_mm"] = [(step.x_mm, step.y_mm)]
    elif step.method is not None:
        # The operator may measure even where the taught height is configured.
        asked["method"] = step.method
    return TouchConfig.model_validate(config.touch.model_dump() | asked) if asked else config.touch


def _touches(config: RigConfig, plane: PaperPlane, step: ZeroTouchStep | TouchStep, dips: int) -> StepMoves:
    """A touch by force or jog decides how deep it goes; a touch by camera also chooses its next spot."""
    touch = touch_of(config, step)
    if touch.method == "taught":
        [point] = touch.points_mm if isinstance(step, TouchStep) else [None]
        return StepMoves([*zero_touch_moves(config)] if point is None else [*visit_moves(config, plane, *point)])
    parts: list[Part] = []
    for rect_mm in touch_rects(config.paper, touch):
        x_mm, y_mm, *_ = rect_mm
        above = over(config, x_mm, y_mm)
        extent_mm = touch.camera.extent_mm if touch.method == "camera" else 0.0
        floor_mm = lowest_z_mm(config.paper, touch, x_mm, y_mm, extent_mm)
        speed_mm_s = max(config.motion.travel_speed_mm_s, config.motion.press_speed_mm_s, touch.speed_mm_s)
        parts += [above, Room.over(config, rect_mm, floor_mm, speed_mm_s), above]
    if touch.method != "camera":
        return StepMoves(parts)
    count = sum(-(-spots // touch.camera.spots_per_dip) for spots in patch_spots(config.paper, touch))
    inked = [move for number in range(count) for move in inking_moves(config, dips + number)]
    return StepMoves([*photograph_moves(config), *inked, *parts, *photograph_moves(config)], dips=count)


def _figure(config: RigConfig, plane: PaperPlane, drawn: Drawn, patch: Patch, dips: int) -> StepMoves:
    parts: list[Part] = []
    made = 0
    for number, points in enumerate(drawn.strokes):
        if drawn.dips_before(number):
            parts += inking_moves(config, dips + made)
            made += 1
        parts += stroke_moves(config, plane, patch, points, drawn.speed_mm_s).parts
    return StepMoves(parts, dips=made)


@dataclass(frozen=True, slots=True)
class Walked:
    """One step of the walk."""

    step: Step
    sheet: int
    """From 1."""
    patch: Patch | None
    """Patch that the step marks or photographs."""
    moves: StepMoves
    more_patches: list[Patch] = field(default_factory=list[Patch])
    """Further patches that the step marks."""


def sheet_of(config: RigConfig, protocol: ProtocolConfig) -> Sheet:
    """The sheet as this protocol divides it."""
    return Sheet(config.paper, protocol.own_patch_mm)


def layout_of(config: RigConfig, protocol: ProtocolConfig) -> Layout:
    """The sheet's columns and rows, and the patches of the first sheet that the self-check uses."""
    sheet = sheet_of(config, protocol)
    if not config.self_check.enabled or not sheet.capacity:
        return sheet.layout
    first = sheet.patch(0)
    return replace(sheet.layout, taken=frozenset({0} | {patch.index for patch in partners(sheet, first, set())}))


def steps_on(config: RigConfig, protocol: ProtocolConfig) -> Protocol:
    """The steps as this rig runs them: balanced over its sheet, with the self-check if it is on."""
    found = protocol.steps(layout_of(config, protocol))
    return with_self_check(found) if config.self_check.enabled else found


def as_planned(step: Step, sheet: int, patch: int) -> StepResult | None:
    """The result of a step that makes its press there, as commanded; None for a step that makes none."""
    match step:
        case PressStep(press=press):
            return PressResult(press=press.model_copy(update={"sheet": sheet, "patch": patch}))
        case DrawStep(press=press):
            return PressResult(kind=StepKind.DRAW, press=press.model_copy(update={"sheet": sheet, "patch": patch}))
        case _:
            return None


def walk(config: RigConfig, protocol: ProtocolConfig) -> Iterator[Walked]:
    """Every step in order, each mark on the next free patch, with a fresh sheet whenever one is full.

    The sheet must have room for at least one patch.
    """
    plane, sheet = PaperPlane(config.paper.touch_z_mm), sheet_of(config, protocol)
    number = dips = 0
    used: set[int] = set()
    generator = steps_on(config, protocol)
    try:
        step = next(generator)
        while True:
            answer: StepResult | None = None
            patch, shown = None, number
            more: tuple[Patch, ...] = ()
            if step.kind in MARKING:
                if len(used) == sheet.capacity:
                    number += 1
                    used.clear()
                patch, shown = sheet.free(used, number + 1), number
                more = partners(sheet, patch, used) if isinstance(step, SelfCheckStep) else ()
                used |= {one.index for one in (patch, *more)}
                answer = as_planned(step, number, patch.index)
            elif isinstance(step, CaptureStep):
                shown = step.press.sheet or 0
                patch = sheet.patch(step.press.patch or 0)
            moves = moves_of(config, plane, step, patch, more, dips=dips)
            dips += moves.dips
            yield Walked(step, shown + 1, patch, moves, list(more))
            step = generator.send(answer)
    except StopIteration:
        return
