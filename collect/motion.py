"""Every list of moves that the arm makes, which a plan checks, times and draws, and their execution in a run."""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from dataclasses import dataclass

from brushloop.collect.errors import StepVoid, arm_at_fault
from brushloop.collect.photograph.photographer import Photographer
from brushloop.collect.protocols.steps import Drawn, TrajectoryPoint
from brushloop.collect.rig.config import RigConfig, WashConfig
from brushloop.collect.rig.devices import Rig, limits_of
from brushloop.collect.rig.paper import PaperPlane, Patch, to_base
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.geometry import brush_pose, interpolate, lean
from brushloop.sessions.records import Condition

CLEARANCE_MM = 8.0
"""Height above the paper at which the fast approach ends."""
DWELL_MM = 0.05
"""Length of the slow end of the descent that serves as the dwell: ARCS's queue can only wait by moving."""
CHECK_APPROACH_MM = 4.0
"""Height above the paper at which the slow approach of a self-check's mark begins."""
CHECK_SPEED_MM_S = 5.0
"""Speed of that approach."""


Move = QueuedLine
"""A straight line to a target, and how fast to go there."""


@dataclass(frozen=True, slots=True)
class Path:
    """Poses to pass through without a halt."""

    poses: list[Pose]
    speed_mm_s: float


class Region(Path):
    """The outermost poses, lowest first, of the region in which a touch that decides by itself may move the upright
    brush; and the highest speed of any move there."""

    @classmethod
    def over(
        cls, config: RigConfig, rect_mm: tuple[float, float, float, float], lowest_z_mm: float, speed_mm_s: float
    ) -> Region:
        """The region over a rectangle of the sheet (x, y, width, height), which may be a point, up to travel height."""
        x_mm, y_mm, size_x_mm, size_y_mm = rect_mm
        places = dict.fromkeys((x, y) for x in (x_mm, x_mm + size_x_mm) for y in (y_mm, y_mm + size_y_mm))
        heights = (lowest_z_mm, config.motion.safe_z_mm)
        return cls([upright(config, *place, z_mm) for z_mm in heights for place in places], speed_mm_s)


Segment = Move | Path
Dip = Callable[[], Awaitable[object]]
"""Fills the brush; begins and ends at travel height."""


# Travel and photographs


def retreat_moves(config: RigConfig, here: Pose) -> list[Move]:
    """From any pose: up along the tool axis to safe height if below it, upright, then to the park position."""
    motion = config.motion
    moves: list[Move] = []
    if here.z_mm < motion.safe_z_mm:
        tilt_deg, heading_deg = lean(here)
        out_mm = (motion.safe_z_mm - here.z_mm) * math.tan(math.radians(tilt_deg))
        x_mm = here.x_mm + out_mm * math.cos(math.radians(heading_deg))
        y_mm = here.y_mm + out_mm * math.sin(math.radians(heading_deg))
        here = Pose(x_mm, y_mm, motion.safe_z_mm, *here.quaternion)
        moves.append(Move(here, motion.press_speed_mm_s))
    # Turn upright before travelling: turning along a long line would sweep the ferrule around.
    turned = brush_pose(*here.position_mm, heading_deg=config.paper.yaw_deg)
    return [*moves, Move(turned, motion.travel_speed_mm_s), park_move(config)]


def park_move(config: RigConfig) -> Move:
    """To the place where the arm waits, out of the camera's view."""
    parked = brush_pose(*config.motion.park_mm, heading_deg=config.paper.yaw_deg)
    return Move(parked, config.motion.travel_speed_mm_s)


def over_sheet_move(config: RigConfig) -> Move:
    """Over the middle of the sheet at travel height, where the camera must see the arm."""
    size_x_mm, size_y_mm = config.paper.size_mm
    return over(config, 0.5 * size_x_mm, 0.5 * size_y_mm)


def photograph_moves(config: RigConfig) -> list[Move]:
    """Over the sheet, unless the arm is there, and out of the camera's view."""
    return [over_sheet_move(config), park_move(config)]


# Ink


def inking_moves(config: RigConfig, dips: int) -> list[Move]:
    """The dip that follows `dips` others in this process, with a wash before it if one is due."""
    wash = config.ink.wash
    washed = wash is not None and dips % wash.every_dips == wash.every_dips - 1
    return [*(wash_moves(config, wash) if wash is not None and washed else ()), *dip_moves(config)]


def dip_moves(config: RigConfig) -> list[Move]:
    """Over the well, down into the ink, up slowly; with a wipe, across the rim on the way up."""
    safe_z_mm, wipe, well = config.motion.safe_z_mm, config.ink.wipe, config.ink.well_mm
    moves = [over(config, *well), slowly(config, *well, config.ink.dip_z_mm)]
    if wipe is None:
        return [*moves, slowly(config, *well, safe_z_mm)]
    across = [slowly(config, *place, wipe.z_mm) for place in (well, wipe.rim_mm)]
    return [*moves, *across, slowly(config, *wipe.rim_mm, safe_z_mm)]


def wash_moves(config: RigConfig, wash: WashConfig) -> list[Move]:
    """Over the pot, down and up `wash.strokes` times, and out."""
    bottom = slowly(config, *wash.pot_mm, wash.dip_z_mm)
    half = slowly(config, *wash.pot_mm, 0.5 * (wash.dip_z_mm + config.motion.safe_z_mm))
    above = over(config, *wash.pot_mm)
    return [above, *[bottom, half] * wash.strokes, above]


# Strokes


def press_moves(
    config: RigConfig, plane: PaperPlane, patch: Patch, condition: Condition, dwell_s: float
) -> tuple[list[Move], list[Move]]:
    """Two lists: over the patch, and down to clearance while the brush tilts; down to touch height and by H, dwell, up.

    The controller carries out the second list by itself, so that list must end above the paper.
    Tilting above the paper gives the same pose at touch as tilting on it, without a smear; on the way down it costs no
    time. On the spot, ARCS would read mm/s as thousandths of rad/s: 10 deg would take 9 s at the speed of a press.
    """
    motion, paper = config.motion, config.paper
    depth_mm, tilt_deg = condition.depth_mm, condition.tilt_deg
    above = over(config, *patch.anchor_mm)

    def pose(above_mm: float) -> Pose:
        return plane.pose(paper, *patch.anchor_mm, above_mm, tilt_deg=tilt_deg)

    touch, deep = pose(0.0), pose(-depth_mm)
    before = [above, Move(pose(CLEARANCE_MM), motion.travel_speed_mm_s)]
    pressing = [
        Move(touch, motion.press_speed_mm_s),
        Move(interpolate(touch, deep, max(0.5, 1.0 - DWELL_MM / depth_mm)), motion.press_speed_mm_s),
        Move(deep, motion.press_speed_mm_s, max(dwell_s, motion.least_dwell_s)),
        Move(pose(CLEARANCE_MM), motion.press_speed_mm_s),
        above,
    ]
    return before, pressing


def stroke_moves(
    config: RigConfig, plane: PaperPlane, patch: Patch, points: Sequence[TrajectoryPoint], speed_mm_s: float
) -> list[Segment]:
    """Over the first point with the wrist turned as the stroke begins, tilt just above the paper, land, follow, lift.

    Points are in the patch's frame: origin at its lower left corner, axes along the sheet's.
    """
    motion, paper = config.motion, config.paper

    def at(point: TrajectoryPoint, above_mm: float, tilt_deg: float) -> Pose:
        x_mm, y_mm = patch.x_mm + point[0], patch.y_mm + point[1]
        return plane.pose(paper, x_mm, y_mm, above_mm, tilt_deg=tilt_deg, turn_deg=point[4])

    def high(point: TrajectoryPoint) -> Pose:
        base = to_base(paper, patch.x_mm + point[0], patch.y_mm + point[1])
        return brush_pose(*base, motion.safe_z_mm, heading_deg=paper.yaw_deg + point[4])

    def clear(point: TrajectoryPoint) -> float:
        return max(CLEARANCE_MM, CLEARANCE_MM - point[2])

    first, *rest = points
    last = points[-1]
    return [
        # The wrist turns during the approach, while the upright brush turns about its own axis.
        Move(high(first), motion.travel_speed_mm_s),
        Move(at(first, clear(first), 0.0), motion.travel_speed_mm_s),
        # The tip stays in place while the brush turns about it: ARCS then reads mm/s as thousandths of rad/s.
        Move(at(first, clear(first), first[3]), motion.travel_speed_mm_s),
        Move(at(first, -first[2], first[3]), motion.press_speed_mm_s),
        Path([at(point, -point[2], point[3]) for point in rest], speed_mm_s),
        Move(at(last, clear(last), last[3]), motion.press_speed_mm_s),
        Move(high(last), motion.travel_speed_mm_s),
    ]


# Touches


def over(config: RigConfig, x_mm: float, y_mm: float) -> Move:
    """To travel height over a point of the paper frame."""
    return Move(upright(config, x_mm, y_mm, config.motion.safe_z_mm), config.motion.travel_speed_mm_s)


def slowly(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Move:
    """To a height over a point of the paper frame, at most travel height, at the speed of a press."""
    return Move(upright(config, x_mm, y_mm, z_mm), config.motion.press_speed_mm_s)


def visit_moves(config: RigConfig) -> list[Move]:
    """Over the zero-touch point, down to clearance, slowly to the taught height, and up."""
    motion, paper = config.motion, config.paper
    x_mm, y_mm = paper.touch_point_mm
    above = over(config, x_mm, y_mm)
    return [
        above,
        Move(upright(config, x_mm, y_mm, paper.touch_z_mm + CLEARANCE_MM), motion.travel_speed_mm_s),
        Move(upright(config, x_mm, y_mm, paper.touch_z_mm), motion.press_speed_mm_s / 4),
        above,
    ]


def mark_moves(config: RigConfig, plane: PaperPlane, x_mm: float, y_mm: float) -> list[Move]:
    """One mark of the self-check: over the place, down near the paper, slowly to its depth, and up."""
    surface_z_mm = plane.touch_z_mm(x_mm, y_mm)
    down = slowly(config, x_mm, y_mm, surface_z_mm + CHECK_APPROACH_MM)
    mark = Move(upright(config, x_mm, y_mm, surface_z_mm - config.self_check.depth_mm), CHECK_SPEED_MM_S)
    return [over(config, x_mm, y_mm), down, mark, slowly(config, x_mm, y_mm, config.motion.safe_z_mm)]


# Poses


def upright(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    """The upright brush over a point of the paper frame, its tip at a height of the base frame; no higher than travel
    height."""
    z_mm = min(z_mm, config.motion.safe_z_mm)
    return brush_pose(*to_base(config.paper, x_mm, y_mm), z_mm, heading_deg=config.paper.yaw_deg)


DEPTH_TOLERANCE_MM = 0.1
"""How far the depth at the end of the dwell may be from the requested one."""
TOUCH_TOLERANCE_MM = 0.1
"""How far the arm may rest from the taught height at zero touch."""
THERE_MM = 0.1
"""How far from the beginning of a dip the arm counts as being there."""


class Procedures:
    """Carries out the moves of each step on the devices of a rig. Every procedure begins and ends at safe height."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._config = rig.config
        self.plane = PaperPlane(rig.config.paper.touch_z_mm)
        """Level, at the taught height, until touches have measured it."""
        self.target_mm: tuple[float, float, float] | None = None
        """Where the arm was last sent; for a press, its deepest point."""
        self._dips = 0
        self.photographer = Photographer(rig, self.go, over_sheet_move(rig.config), park_move(rig.config))

    async def go(self, *segments: Segment) -> None:
        """Make moves and follow paths one after the other, each when the arm rests after the one before."""
        robot, acc_mm_s2 = self.rig.robot, self._config.motion.acc_mm_s2
        for segment in segments:
            poses = [segment.target] if isinstance(segment, Move) else segment.poses
            self.target_mm = poses[-1].position_mm
            await robot.follow(poses, speed_mm_s=segment.speed_mm_s, acc_mm_s2=acc_mm_s2)

    async def queue(self, moves: Sequence[Move]) -> list[Pose]:
        """Send all moves to the controller before the first begins; it then ends them whatever happens to this program.

        Returns the poses that were seen meanwhile.
        """
        self.target_mm = min((move.target.position_mm for move in moves), key=lambda at: at[2], default=None)
        return await self.rig.robot.sequence(moves, acc_mm_s2=self._config.motion.acc_mm_s2)

    async def retreat(self) -> None:
        """Lift along the tool axis to safe height, then park. A killed process may have left the brush down."""
        here = await self.rig.robot.take_up()
        limits_of(self._config).check_start("robot", here)
        await self.go(*retreat_moves(self._config, here))

    async def zero_touch(self) -> float:
        """Visit the taught touch height at the touch point; returns the height at which the arm rests, in mm.

        This confirms that the arm reaches the height that the operator taught. It does not measure the paper. Raises
        `StepVoid` if the arm rests elsewhere.
        """
        *down, up = visit_moves(self._config)
        await self.go(*down)
        rests_mm = (await self.rig.robot.where()).z_mm
        await self.go(up)
        off_mm = rests_mm - self._config.paper.touch_z_mm
        if abs(off_mm) > TOUCH_TOLERANCE_MM:
            raise StepVoid(f"zero touch is {off_mm:+.3f} mm off the taught height; limit {TOUCH_TOLERANCE_MM} mm")
        return rests_mm

    async def lower(self, x_mm: float, y_mm: float, z_mm: float, speed_mm_s: float) -> float:
        """Go to a height over a point of the sheet; returns the height at which the arm rests, in mm."""
        await self.go(Move(upright(self._config, x_mm, y_mm, z_mm), speed_mm_s))
        return (await self.rig.robot.where()).z_mm

    async def lift(self) -> None:
        """Go straight up to travel height from wherever the tip is."""
        here, motion = await self.rig.robot.where(), self._config.motion
        if here.z_mm < motion.safe_z_mm:
            await self.go(Move(Pose(here.x_mm, here.y_mm, motion.safe_z_mm, *here.quaternion), motion.press_speed_mm_s))

    @contextlib.asynccontextmanager
    async def lifted_after(self) -> AsyncGenerator[None]:
        """Lift at the end and after an error, unless the arm is at fault. After a stop the arm stays where it is."""
        try:
            yield
        except Exception as error:
            if arm_at_fault(error):
                raise
            try:
                await self.lift()
            except Exception as trouble:
                error.add_note(f"The brush could not be lifted: {trouble}")
            raise
        await self.lift()

    async def set_out(self) -> None:
        """Go to where the next dip or wash begins, at travel height."""
        await self.go(inking_moves(self._config, self._dips)[0])

    async def dip(self) -> None:
        """Dip into the well and wipe; wash first if a wash is due. After `set_out` the arm is there already."""
        first, *moves = inking_moves(self._config, self._dips)
        if math.dist((await self.rig.robot.where()).position_mm, first.target.position_mm) > THERE_MM:
            moves.insert(0, first)
        await self.go(*moves)
        self._dips += 1

    async def press(self, patch: Patch, condition: Condition, dwell_s: float) -> float:
        """Press once; returns the depth reached below the paper along its normal, in mm."""
        before, pressing = press_moves(self._config, self.plane, patch, condition, dwell_s)
        await self.go(*before)
        seen = await self.queue(pressing)
        reached_mm = max((-self.plane.above_mm(self._config.paper, pose) for pose in seen), default=0.0)
        if abs(reached_mm - condition.depth_mm) > DEPTH_TOLERANCE_MM:
            raise StepVoid(f"the depth was {reached_mm:.3f} mm, {condition.depth_mm:g} mm was commanded")
        return reached_mm

    async def stroke(self, patch: Patch, drawn: Drawn, number: int) -> float:
        """Draw stroke `number`, from 0, of a figure whose poses were checked; begins and ends at safe height.

        Returns the depth at which the brush landed, in mm.
        """
        points, speed_mm_s = drawn.strokes[number], drawn.speed_mm_s
        *down, path, lift, up = stroke_moves(self._config, self.plane, patch, points, speed_mm_s)
        await self.go(*down)
        depth_mm = -self.plane.above_mm(self._config.paper, await self.rig.robot.where())
        await self.go(path, lift, up)
        return depth_mm
