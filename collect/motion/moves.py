"""Every list of moves that the arm makes: a plan checks, times and draws the lists that a run carries out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from brushloop.collect.protocols.steps import TrajectoryPoint
from brushloop.collect.rig.config import RigConfig, WashConfig
from brushloop.collect.rig.paper import PaperPlane, Patch, to_base
from brushloop.drivers.devices import Pose
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


@dataclass(frozen=True, slots=True)
class Move:
    """A straight line to a target, and how fast to go there."""

    target: Pose
    speed_mm_s: float
    least_s: float = 0.0
    """Minimum duration."""


@dataclass(frozen=True, slots=True)
class Way:
    """Poses to pass through without a halt."""

    poses: list[Pose]
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class Room:
    """The outermost poses of the region in which a touch that decides by itself may move the upright brush."""

    poses: tuple[Pose, ...]
    """Lowest first."""
    speed_mm_s: float
    """Highest speed of any move in the region."""

    @classmethod
    def over(
        cls, config: RigConfig, rect_mm: tuple[float, float, float, float], lowest_z_mm: float, speed_mm_s: float
    ) -> Room:
        """The region over a rectangle of the sheet (x, y, width, height), which may be a point, up to travel height."""
        x_mm, y_mm, size_x_mm, size_y_mm = rect_mm
        places = dict.fromkeys((x, y) for x in (x_mm, x_mm + size_x_mm) for y in (y_mm, y_mm + size_y_mm))
        heights = (lowest_z_mm, config.motion.safe_z_mm)
        return cls(tuple(touching(config, *place, z_mm) for z_mm in heights for place in places), speed_mm_s)


Part = Move | Way | Room


def commanded(parts: Iterable[Part]) -> list[tuple[Pose, float]]:
    """Every pose with its speed in mm/s; of a `Room`, the outermost poses."""
    found: list[tuple[Pose, float]] = []
    for part in parts:
        match part:
            case Move():
                found.append((part.target, part.speed_mm_s))
            case Way() | Room():
                found += [(pose, part.speed_mm_s) for pose in part.poses]
    return found


# Travel and photographs


def retreat_moves(config: RigConfig, here: Pose) -> list[Move]:
    """From any pose: up along the tool axis to safe height if below it, upright, then to the park position."""
    motion = config.motion
    moves: list[Move] = []
    x_mm, y_mm, z_mm = here.position_mm
    if here.z_mm < motion.safe_z_mm:
        tilt_deg, heading_deg = lean(here)
        rise_mm = motion.safe_z_mm - here.z_mm
        out_mm = rise_mm * math.tan(math.radians(tilt_deg))
        x_mm += out_mm * math.cos(math.radians(heading_deg))
        y_mm += out_mm * math.sin(math.radians(heading_deg))
        qx, qy, qz, qw = here.quaternion
        z_mm = motion.safe_z_mm
        moves.append(Move(Pose(x_mm, y_mm, z_mm, qx, qy, qz, qw), motion.press_speed_mm_s))
    # Turn upright before travelling: turning along a long line would sweep the ferrule around.
    moves.append(Move(_upright_in_base(config, x_mm, y_mm, z_mm), motion.travel_speed_mm_s))
    return moves + park_moves(config)


def park_moves(config: RigConfig) -> list[Move]:
    """To the place where the arm waits, out of the camera's view."""
    return [Move(_upright_in_base(config, *config.motion.park_mm), config.motion.travel_speed_mm_s)]


def over_sheet_move(config: RigConfig) -> Move:
    """Over the middle of the sheet at travel height, where the camera must see the arm."""
    size_x_mm, size_y_mm = config.paper.size_mm
    return over(config, 0.5 * size_x_mm, 0.5 * size_y_mm)


def photograph_moves(config: RigConfig) -> list[Move]:
    """Over the sheet, unless the arm is there, and out of the camera's view."""
    return [over_sheet_move(config), *park_moves(config)]


# Ink


def inking_moves(config: RigConfig, dips: int) -> list[Move]:
    """The dip that follows `dips` others in this process, with a wash before it if one is due."""
    wash = config.ink.wash
    washed = wash is not None and dips % wash.every_dips == wash.every_dips - 1
    return [*(wash_moves(config, wash) if wash is not None and washed else ()), *dip_moves(config)]


def dip_moves(config: RigConfig) -> list[Move]:
    """Over the well, down into the ink, up slowly; with a wipe, across the rim on the way up."""
    motion, wipe, well = config.motion, config.ink.wipe, config.ink.well_mm
    moves = [over(config, *well), Move(upright(config, *well, config.ink.dip_z_mm), motion.press_speed_mm_s)]
    if wipe is None:
        return [*moves, up(config, *well)]
    across = [Move(upright(config, *place, wipe.z_mm), motion.press_speed_mm_s) for place in (well, wipe.rim_mm)]
    return [*moves, *across, up(config, *wipe.rim_mm)]


def wash_moves(config: RigConfig, wash: WashConfig) -> list[Move]:
    """Over the pot, down and up `wash.strokes` times, and out."""
    speed_mm_s = config.motion.press_speed_mm_s
    bottom = Move(upright(config, *wash.pot_mm, wash.dip_z_mm), speed_mm_s)
    half = Move(upright(config, *wash.pot_mm, 0.5 * (wash.dip_z_mm + config.motion.safe_z_mm)), speed_mm_s)
    above = over(config, *wash.pot_mm)
    return [above, *[bottom, half] * wash.strokes, above]


# Strokes


def press_moves(
    config: RigConfig, plane: PaperPlane, patch: Patch, condition: Condition, dwell_s: float = 0.0
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


@dataclass(frozen=True, slots=True)
class StrokeMoves:
    """One drawn stroke: single moves to its first point, the way through the others, single moves up from the last."""

    down: list[Move]
    way: Way
    up: list[Move]

    @property
    def parts(self) -> list[Part]:
        """All moves in order."""
        return [*self.down, self.way, *self.up]


def stroke_moves(
    config: RigConfig, plane: PaperPlane, patch: Patch, points: Sequence[TrajectoryPoint], speed_mm_s: float
) -> StrokeMoves:
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
    down = [
        # The wrist turns during the approach, while the upright brush turns about its own axis.
        Move(high(first), motion.travel_speed_mm_s),
        Move(at(first, clear(first), 0.0), motion.travel_speed_mm_s),
        # The tip stays in place while the brush turns about it: ARCS then reads mm/s as thousandths of rad/s.
        Move(at(first, clear(first), first[3]), motion.travel_speed_mm_s),
        Move(at(first, -first[2], first[3]), motion.press_speed_mm_s),
    ]
    lifted = [
        Move(at(last, clear(last), last[3]), motion.press_speed_mm_s),
        Move(high(last), motion.travel_speed_mm_s),
    ]
    return StrokeMoves(down, Way([at(point, -point[2], point[3]) for point in rest], speed_mm_s), lifted)


# Touches


def over(config: RigConfig, x_mm: float, y_mm: float) -> Move:
    """To travel height over a point of the paper frame."""
    return Move(upright(config, x_mm, y_mm, config.motion.safe_z_mm), config.motion.travel_speed_mm_s)


def near(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Move:
    """From travel height down to where a slow approach begins."""
    return Move(touching(config, x_mm, y_mm, z_mm), config.motion.press_speed_mm_s)


def up(config: RigConfig, x_mm: float, y_mm: float) -> Move:
    """Slowly up to travel height over a point."""
    return Move(upright(config, x_mm, y_mm, config.motion.safe_z_mm), config.motion.press_speed_mm_s)


def lift(config: RigConfig, here: Pose) -> list[Move]:
    """Straight up to travel height from wherever the tip is; no move if it is there already."""
    high = Pose(here.x_mm, here.y_mm, config.motion.safe_z_mm, *here.quaternion)
    return [Move(high, config.motion.press_speed_mm_s)] if here.z_mm < config.motion.safe_z_mm else []


def zero_touch_moves(config: RigConfig) -> list[Move]:
    """To the taught height at the touch point."""
    return visit_moves(config, PaperPlane(config.paper.touch_z_mm), *config.paper.touch_point_mm)


def visit_moves(config: RigConfig, plane: PaperPlane, x_mm: float, y_mm: float) -> list[Move]:
    """Over a point of the sheet, down to clearance, slowly to the expected surface, and up."""
    motion, paper = config.motion, config.paper
    above = over(config, x_mm, y_mm)
    return [
        above,
        Move(plane.pose(paper, x_mm, y_mm, CLEARANCE_MM), motion.travel_speed_mm_s),
        Move(plane.pose(paper, x_mm, y_mm, 0.0), motion.press_speed_mm_s / 4),
        above,
    ]


def mark_moves(config: RigConfig, plane: PaperPlane, x_mm: float, y_mm: float) -> list[Move]:
    """One mark of the self-check: over the place, down near the paper, slowly to its depth, and up."""
    surface_z_mm = plane.touch_z_mm(x_mm, y_mm)
    down = near(config, x_mm, y_mm, surface_z_mm + CHECK_APPROACH_MM)
    mark = Move(touching(config, x_mm, y_mm, surface_z_mm - config.self_check.depth_mm), CHECK_SPEED_MM_S)
    return [over(config, x_mm, y_mm), down, mark, up(config, x_mm, y_mm)]


# Poses


def touching(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    """Like `upright`, but no higher than travel height."""
    return upright(config, x_mm, y_mm, min(z_mm, config.motion.safe_z_mm))


def upright(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    """The upright brush over a point of the paper frame, its tip at a height of the base frame."""
    return _upright_in_base(config, *to_base(config.paper, x_mm, y_mm), z_mm)


def _upright_in_base(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    return brush_pose(x_mm, y_mm, z_mm, heading_deg=config.paper.yaw_deg)
