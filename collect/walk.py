"""Walks a protocol as if every step succeeded: each step, its patch and its moves; and the check of every pose that it
can command against the limits. Nothing moves, and nothing connects but to ask the controller whether it reaches a pose.

Poses are checked on every patch, because a void press moves all later ones to other patches.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from brushloop.collect.errors import ConfigError, StepError
from brushloop.collect.motion import (
    Move,
    Region,
    Segment,
    inking_moves,
    mark_moves,
    over,
    park_move,
    photograph_moves,
    press_moves,
    stroke_moves,
    visit_moves,
)
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.collect.protocols.steps import (
    MARKING,
    BoardStep,
    CaptureStep,
    DipStep,
    Drawn,
    Planned,
    PressStep,
    ReviewStep,
    SelfCheckStep,
    Step,
    ZeroTouchStep,
    press_of,
)
from brushloop.collect.rig.config import BrushConfig, PaperConfig, RigConfig, TouchConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import PaperPlane, Patch, Sheet
from brushloop.collect.touch.camera import most_dips
from brushloop.collect.touch.measure import touched_regions
from brushloop.collect.touch.selfcheck import partners, triangle_on
from brushloop.drivers.arcs.controller import only_asking
from brushloop.drivers.arcs.wire import numbers
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import LimitExceeded, ProtocolViolation
from brushloop.drivers.geometry import from_wire, inverse, product, to_wire, turned
from brushloop.sessions.events import PressResult, StepResult
from brushloop.sessions.records import Condition


@dataclass(frozen=True, slots=True)
class StepMoves:
    """The moves of a step in order, and what else in it takes time or ink."""

    segments: Sequence[Segment] = ()
    captures: int = 0
    dips: int = 0

    @property
    def poses(self) -> list[tuple[Pose, float]]:
        """Every pose that is commanded, with its speed in mm/s; of a `Region`, the outermost poses."""
        return [
            (pose, segment.speed_mm_s)
            for segment in self.segments
            for pose in ([segment.target] if isinstance(segment, Move) else segment.poses)
        ]


def moves_of(
    config: RigConfig, plane: PaperPlane, step: Step, patches: Sequence[Patch] = (), *, dips: int = 0
) -> StepMoves:
    """The moves of a step, as the run makes them, on the patches that it marks.

    `dips` is the number of dips before the step, which decides when the brush is washed.
    """
    match step:
        case ZeroTouchStep():
            return _touches(config, step, dips)
        case DipStep():
            return StepMoves(inking_moves(config, dips), dips=1)
        case ReviewStep():
            return StepMoves()
        case BoardStep():
            return StepMoves(photograph_moves(config), captures=1)
        case CaptureStep():
            return StepMoves([*photograph_moves(config), inking_moves(config, dips)[0]], captures=1)
        case PressStep(press=press, dwell_s=dwell_s, drawn=drawn):
            [patch] = patches
            if drawn is not None:
                return _figure(config, plane, drawn, patch, dips)
            before, pressing = press_moves(config, plane, patch, press.condition, dwell_s)
            return StepMoves([*before, *pressing])
        case SelfCheckStep():
            moves = [
                move
                for number, place_mm in enumerate(triangle_on(patches))
                for move in (*inking_moves(config, dips + number), *mark_moves(config, plane, *place_mm))
            ]
            return StepMoves([*photograph_moves(config), *moves, *photograph_moves(config)], dips=3, captures=2)


def touch_of(config: RigConfig, step: ZeroTouchStep) -> TouchConfig:
    """How and where a ZERO_TOUCH step touches. The operator may measure even where the taught height is configured."""
    return config.touch if step.method is None else config.touch.model_copy(update={"method": step.method})


def _touches(config: RigConfig, step: ZeroTouchStep, dips: int) -> StepMoves:
    """A touch by force or jog decides how deep it goes; a touch by camera also chooses its next spot."""
    touch = touch_of(config, step)
    if touch.method == "taught":
        return StepMoves(visit_moves(config))
    segments: list[Segment] = []
    for rect_mm, floor_mm in touched_regions(config.paper, touch):
        x_mm, y_mm, *_ = rect_mm
        above = over(config, x_mm, y_mm)
        speed_mm_s = max(config.motion.travel_speed_mm_s, config.motion.press_speed_mm_s, touch.speed_mm_s)
        segments += [above, Region.over(config, rect_mm, floor_mm, speed_mm_s), above]
    if touch.method != "camera":
        return StepMoves(segments)
    count = most_dips(config.paper, touch)
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
    """Patches that the step marks."""


def sheet_of(config: RigConfig, protocol: ProtocolConfig) -> Sheet:
    """The sheet as this protocol divides it: into patches of the rig, or of the size that figures need."""
    return Sheet(config.paper, protocol.cell_mm if isinstance(protocol, WriteConfig) else None)


def as_planned(step: Step, sheet: int, patch: int) -> StepResult | None:
    """The result of a step that makes its press there, as commanded; None for a step that makes none."""
    if not isinstance(step, PressStep):
        return None
    return PressResult(press=step.press.model_copy(update={"sheet": sheet, "patch": patch}))


def patches_of(step: Step, sheet: Sheet, used: set[int], number: int) -> tuple[Patch, ...]:
    """Free patches that a step marks: one, or three for a self-check. Raises `SheetFull`, naming sheet `number`."""
    if step.kind not in MARKING:
        return ()
    patch = sheet.free(used, number)
    return (patch, *(partners(sheet, patch, used) if isinstance(step, SelfCheckStep) else ()))


def walk(config: RigConfig, protocol: ProtocolConfig) -> Iterator[Walked]:
    """Every step in order, each mark on the next free patch, with a fresh sheet whenever one is full.

    The sheet must have room for at least one patch.
    """
    sheet, used, number = sheet_of(config, protocol), set[int](), 0
    generator = protocol.steps(self_check=bool(config.self_check.enabled))
    with contextlib.suppress(StopIteration):
        step = next(generator)
        while True:
            if step.kind in MARKING and len(used) == sheet.capacity:
                number += 1
                used.clear()
            patches = patches_of(step, sheet, used, number + 1)
            used |= {patch.index for patch in patches}
            yield Walked(step, number + 1, patches)
            step = generator.send(as_planned(step, number, patches[0].index if patches else 0))


# Checks before motion

TOUCH_CLEAR_MM = 5.0
"""Least distance of the zero-touch point from ink."""
PlannedPose = tuple[Pose, float, str]
"""A pose that a step commands, its speed in mm/s, and the name of what it belongs to."""


def check_protocol(rig_path: Path, protocol_path: Path, rig: RigConfig, protocol: ProtocolConfig) -> None:
    """Raise `ConfigError` with file, field and range for the first problem."""
    strokes, sheet = protocol.planned(), sheet_of(rig, protocol)
    _check_sheet(rig_path, protocol_path, rig, protocol, sheet)
    _check_brush(protocol_path, rig.brush, strokes, sheet.patch(0))
    _check_touch_point(rig_path, rig.paper, strokes, sheet)
    check_poses(rig_path, rig, all_poses(rig, protocol, PaperPlane(rig.paper.touch_z_mm)))


def _check_sheet(rig_path: Path, path: Path, rig: RigConfig, protocol: ProtocolConfig, sheet: Sheet) -> None:
    if sheet.capacity == 0:
        where, field = (path, "cell_mm") if isinstance(protocol, WriteConfig) else (rig_path, "paper.cell_mm")
        raise ConfigError(where, field, f"{sheet.cell_mm} mm does not fit on a sheet of {rig.paper.size_mm} mm")
    if rig.self_check.enabled:
        try:
            triangle_on((sheet.patch(0),))
        except StepError as error:
            what = f"{error}; --arm switches the self-check on, `enabled = false` switches it off for a new session"
            raise ConfigError(rig_path, "paper.cell_mm", what) from None


def _check_brush(path: Path, brush: BrushConfig, strokes: Iterable[Planned], patch: Patch) -> None:
    for stroke in strokes:
        for _, _, asked in marks_of(stroke, patch):
            bundle_mm = brush.length_mm * math.cos(math.radians(asked.tilt_deg))
            bundle = f"the height of the bundle at a tilt of {asked.tilt_deg:g} deg"
            for name, most_mm in (("the rig's brush.max_depth_mm", brush.max_depth_mm), (bundle, bundle_mm)):
                if asked.depth_mm > most_mm:
                    what = f"{asked.depth_mm:g} mm is deeper than {name} = {most_mm:.4g} mm allows"
                    raise ConfigError(path, stroke.stroke_id, what)


def _check_touch_point(rig_path: Path, paper: PaperConfig, strokes: Iterable[Planned], sheet: Sheet) -> None:
    first = sheet.patch(0)
    marks = {(x_mm, y_mm) for stroke in strokes for x_mm, y_mm, _ in marks_of(stroke, first)}
    for patch in map(sheet.patch, range(sheet.capacity)):
        right_mm, up_mm = patch.x_mm - first.x_mm, patch.y_mm - first.y_mm
        for x_mm, y_mm in marks:
            at_mm = x_mm + right_mm, y_mm + up_mm
            if math.dist(at_mm, paper.touch_point_mm) < TOUCH_CLEAR_MM:
                where = [round(v, 1) for v in at_mm]
                what = f"{[*paper.touch_point_mm]} lies within {TOUCH_CLEAR_MM:g} mm of ink at {where}"
                raise ConfigError(rig_path, "paper.touch_point_mm", what)


def check_poses(rig_path: Path, rig: RigConfig, poses: Iterable[PlannedPose]) -> None:
    """Raise `ConfigError` for the first pose that is outside the limits."""
    limits, acc_mm_s2 = limits_of(rig), rig.motion.acc_mm_s2
    for pose, speed_mm_s, where in poses:
        try:
            limits.check("robot", pose, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)
        except LimitExceeded as error:
            what = f"a planned pose is outside the limits: {error.what} ({where})"
            raise ConfigError(rig_path, "robot.limits", what) from None


def all_poses(rig: RigConfig, protocol: ProtocolConfig, plane: PaperPlane) -> Iterator[PlannedPose]:
    """Everything that the protocol can command over this plane, taught or measured by touch, on every patch."""
    parked, sheet = park_move(rig), sheet_of(rig, protocol)
    yield parked.target, parked.speed_mm_s, "park"
    distinct: dict[object, Step] = {}  # by all that the moves of a step depend on
    for walked in walk(rig, protocol):
        step = replace(walked.step, index=0)
        if isinstance(step, PressStep | CaptureStep):
            distinct.setdefault((step.kind, step.press.condition, repr(step.drawn)), step)
        else:
            distinct.setdefault(step, step)
    for step in distinct.values():
        if step.kind not in MARKING:
            yield from step_poses(rig, plane, step)
            continue
        for patch in map(sheet.patch, range(sheet.capacity)):
            yield from step_poses(rig, plane, step, (patch,))
            if isinstance(step, SelfCheckStep):  # it marks one patch, or three
                yield from step_poses(rig, plane, step, (patch, patch, patch))


def step_poses(rig: RigConfig, plane: PaperPlane, step: Step, patches: Sequence[Patch] = ()) -> Iterator[PlannedPose]:
    """Everything that a step can command on the patches that it marks."""
    name = str(step.kind) if (press := press_of(step)) is None else press.stroke_id
    where = f"{name} on patch {patches[0].index}" if patches else name
    # Assume that a wash is due: when one is due depends on the step at which the process starts.
    dips = 0 if rig.ink.wash is None else rig.ink.wash.every_dips - 1
    yield from ((pose, speed, where) for pose, speed in moves_of(rig, plane, step, patches, dips=dips).poses)


async def ask_reach(rig_path: Path, config: RigConfig, poses: Iterable[PlannedPose]) -> int:
    """Ask the controller for the joints of each pose, near those of the previous one; return how many are distinct.

    Powers, sets and moves nothing. The tool that is set on the controller stays: every pose is converted to that tool.
    Raises `ConfigError` for the first pose that is out of reach, and `DeviceError`.
    """
    robot, names = config.robot, dict[Pose, str]()
    for pose, _, name in poses:
        names.setdefault(pose, name)
    own_tool = from_wire([*(v / 1e3 for v in robot.tcp_offset_mm), *map(math.radians, robot.tcp_rotation_deg)])
    async with only_asking(robot.host, robot.port, robot.framing) as controller:
        set_tool = from_wire(await controller.ask_numbers("RobotConfig.getTcpOffset"))
        near = await controller.ask_numbers("RobotState.getJointPositions")
        for pose, name in names.items():
            wire = to_wire(_for_tool(pose, own_tool, set_tool))
            match await controller.ask("RobotAlgorithm.inverseKinematics", qnear=near, pose=wire):
                case [list(joints), 0]:  # pyright: ignore[reportUnknownVariableType]
                    near = numbers("inverseKinematics", joints)  # pyright: ignore[reportUnknownArgumentType]
                case [_, int()]:
                    raise ConfigError(
                        rig_path,
                        "paper",
                        f"the controller finds no joint solution for {name}: "
                        f"x = {pose.x_mm:.1f}, y = {pose.y_mm:.1f}, z = {pose.z_mm:.1f} mm, "
                        "with the tool of robot.tcp_offset_mm. Move the paper nearer to the arm, or change its yaw",
                    )
                case other:
                    raise ProtocolViolation("robot", "inverseKinematics", f"no return code: {other!r}")
    return len(names)


def _for_tool(tip: Pose, own_tool: Pose, set_tool: Pose) -> Pose:
    """Pose of the controller's tool while our tip is at `tip`: tip * ours^-1 * theirs."""
    flange = product(tip.quaternion, inverse(own_tool.quaternion))
    shift_mm = turned(flange, [t - o for t, o in zip(set_tool.position_mm, own_tool.position_mm, strict=True)])
    px, py, pz = (p + s for p, s in zip(tip.position_mm, shift_mm, strict=True))
    return Pose(px, py, pz, *product(flange, set_tool.quaternion))
