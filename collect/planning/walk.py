"""Walks a protocol as if every step succeeded: each step, its patch and its moves. Nothing connects, nothing moves."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from brushloop.collect.motion import (
    Move,
    Region,
    Segment,
    inking_moves,
    mark_moves,
    over,
    photograph_moves,
    press_moves,
    stroke_moves,
    visit_moves,
)
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.steps import (
    MARKING,
    BoardStep,
    CaptureStep,
    DipStep,
    Drawn,
    DrawStep,
    Planned,
    PressStep,
    Protocol,
    ReviewStep,
    SelfCheckStep,
    Step,
    TouchStep,
    ZeroTouchStep,
    with_self_check,
)
from brushloop.collect.rig.config import RigConfig, TouchConfig
from brushloop.collect.rig.paper import PaperPlane, Patch, Sheet
from brushloop.collect.touch.camera import SPOTS_PER_DIP
from brushloop.collect.touch.heights import EXTENT_MM, lowest_z_mm, patch_spots, touch_rects
from brushloop.collect.touch.selfcheck import partners, triangle_on
from brushloop.drivers.devices import Pose
from brushloop.sessions.events import PressResult, StepKind, StepResult
from brushloop.sessions.records import Condition


def poses_of(segment: Segment) -> Sequence[Pose]:
    """Every pose that a segment commands; of a region, the outermost ones."""
    return (segment.target,) if isinstance(segment, Move) else segment.poses


@dataclass(frozen=True, slots=True)
class StepMoves:
    """The moves of a step in order, and what else in it takes time or ink."""

    segments: list[Segment] = field(default_factory=list[Segment])
    dwell_s: float = 0.0
    captures: int = 0
    dips: int = 0

    @property
    def poses(self) -> list[tuple[Pose, float]]:
        """Every pose that is commanded, with its speed in mm/s; of a `Region`, the outermost poses."""
        return [(pose, segment.speed_mm_s) for segment in self.segments for pose in poses_of(segment)]


def moves_of(
    config: RigConfig,
    plane: PaperPlane,
    step: Step,
    patches: Sequence[Patch] = (),
    *,
    dips: int = 0,
) -> StepMoves:
    """The moves of a step, as the run makes them, on the patches that it marks.

    `dips` is the number of dips before the step, which decides when the brush is washed.
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
            [patch] = patches
            down, up = press_moves(config, plane, patch, press.condition)
            return StepMoves([*down, *up], dwell_s=dwell_s)
        case SelfCheckStep():
            moves = [
                move
                for number, place_mm in enumerate(triangle_on(patches, config.self_check))
                for move in (*inking_moves(config, dips + number), *mark_moves(config, plane, *place_mm))
            ]
            return StepMoves([*photograph_moves(config), *moves, *photograph_moves(config)], dips=3, captures=2)
        case DrawStep(drawn=drawn):
            [patch] = patches
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
        if isinstance(step, TouchStep):
            return StepMoves([*visit_moves(config, plane, step.x_mm, step.y_mm)])
        return StepMoves([*visit_moves(config, PaperPlane(config.paper.touch_z_mm), *config.paper.touch_point_mm)])
    segments: list[Segment] = []
    for rect_mm in touch_rects(config.paper, touch):
        x_mm, y_mm, *_ = rect_mm
        above = over(config, x_mm, y_mm)
        extent_mm = EXTENT_MM if touch.method == "camera" else 0.0
        floor_mm = lowest_z_mm(config.paper, touch, x_mm, y_mm, extent_mm)
        speed_mm_s = max(config.motion.travel_speed_mm_s, config.motion.press_speed_mm_s, touch.speed_mm_s)
        segments += [above, Region.over(config, rect_mm, floor_mm, speed_mm_s), above]
    if touch.method != "camera":
        return StepMoves(segments)
    count = sum(-(-spots // SPOTS_PER_DIP) for spots in patch_spots(config.paper, touch))
    inked = [move for number in range(count) for move in inking_moves(config, dips + number)]
    return StepMoves([*photograph_moves(config), *inked, *segments, *photograph_moves(config)], dips=count)


def _figure(config: RigConfig, plane: PaperPlane, drawn: Drawn, patch: Patch, dips: int) -> StepMoves:
    """Every stroke of a figure; the DIP step has served the first, and the brush dips before each other one."""
    segments: list[Segment] = []
    for number, points in enumerate(drawn.strokes):
        if number > 0:
            segments += inking_moves(config, dips + number - 1)
        segments += stroke_moves(config, plane, patch, points, drawn.speed_mm_s)
    return StepMoves(segments, dips=len(drawn.strokes) - 1)


def marks_of(stroke: Planned, patch: Patch) -> Iterator[tuple[float, float, Condition]]:
    """(x, y, what is commanded there) in the paper frame: the press on this patch, or each point of the figure."""
    if stroke.drawn is None:
        yield *patch.anchor_mm, stroke.condition
        return
    for x_mm, y_mm, depth_mm, tilt_deg, _ in itertools.chain.from_iterable(stroke.drawn.strokes):
        yield patch.x_mm + x_mm, patch.y_mm + y_mm, Condition(depth_mm, tilt_deg)


@dataclass(frozen=True, slots=True)
class Walked:
    """One step of a plan."""

    step: Step
    sheet: int
    """From 1."""
    patches: tuple[Patch, ...]
    """Patches that the step marks, or the one that it photographs."""
    moves: StepMoves = field(default_factory=StepMoves)


def sheet_of(config: RigConfig, protocol: ProtocolConfig) -> Sheet:
    """The sheet as this protocol divides it."""
    return Sheet(config.paper, protocol.own_patch_mm)


def steps_on(config: RigConfig, protocol: ProtocolConfig) -> Protocol:
    """The steps as this rig runs them: balanced over its sheet, with the self-check if it is on."""
    steps = protocol.steps(sheet_of(config, protocol).layout)
    return with_self_check(steps) if config.self_check.enabled else steps


def as_planned(step: Step, sheet: int, patch: int) -> StepResult | None:
    """The result of a step that makes its press there, as commanded; None for a step that makes none."""
    match step:
        case PressStep(press=press):
            return PressResult(press=press.model_copy(update={"sheet": sheet, "patch": patch}))
        case DrawStep(press=press):
            return PressResult(kind=StepKind.DRAW, press=press.model_copy(update={"sheet": sheet, "patch": patch}))
        case _:
            return None


def patches_of(step: Step, sheet: Sheet, used: set[int], number: int) -> tuple[Patch, ...]:
    """Free patches that a step marks: one, or three for a self-check. Raises `SheetFull`, naming sheet `number`."""
    if step.kind not in MARKING:
        return ()
    patch = sheet.free(used, number)
    return (patch, *(partners(sheet, patch, used) if isinstance(step, SelfCheckStep) else ()))


def placed_steps(config: RigConfig, protocol: ProtocolConfig) -> Iterator[Walked]:
    """Every step in order, each mark on the next free patch, with a fresh sheet whenever one is full; without moves.

    The sheet must have room for at least one patch.
    """
    sheet, used, number = sheet_of(config, protocol), set[int](), 0
    generator = steps_on(config, protocol)
    with contextlib.suppress(StopIteration):
        step = next(generator)
        while True:
            if step.kind in MARKING and len(used) == sheet.capacity:
                number += 1
                used.clear()
            patches, shown = patches_of(step, sheet, used, number + 1), number
            used |= {patch.index for patch in patches}
            if isinstance(step, CaptureStep):
                patches, shown = (sheet.patch(step.press.patch or 0),), step.press.sheet or 0
            yield Walked(step, shown + 1, patches)
            step = generator.send(as_planned(step, number, patches[0].index if patches else 0))


def walk(config: RigConfig, protocol: ProtocolConfig) -> Iterator[Walked]:
    """Every step of `placed_steps` with its moves, over the taught plane."""
    plane, dips = PaperPlane(config.paper.touch_z_mm), 0
    for placed in placed_steps(config, protocol):
        moves = moves_of(config, plane, placed.step, placed.patches, dips=dips)
        dips += moves.dips
        yield replace(placed, moves=moves)
