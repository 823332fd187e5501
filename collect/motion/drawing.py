"""What the arm does to draw: down on the first point of a stroke, along the others without a halt, and up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from collect.motion.procedures import CLEARANCE_MM, Move
from collect.protocols.rows import TrajectoryPoint
from collect.protocols.steps import Step
from collect.protocols.strokes import strokes_of
from collect.rig.config import RigConfig
from collect.rig.paper import Cell, PaperPlane, to_base
from drivers.geometry import brush_pose
from drivers.limits import Limits
from drivers.protocols import Robot
from drivers.samples import Pose


@dataclass(frozen=True, slots=True)
class Drawn:
    """What a DRAW step asks for, out of its parameters."""

    strokes: list[list[TrajectoryPoint]]
    cell_mm: tuple[float, float]
    speed_mm_s: float
    blend_mm: float
    dip_every_strokes: int

    @classmethod
    def of(cls, step: Step) -> Drawn:
        """Raises KeyError or ValueError for a step that draws nothing."""
        params = step.params
        return cls(
            strokes_of(str(params["strokes"])),
            (float(params["cell_w_mm"] or 0), float(params["cell_h_mm"] or 0)),
            float(params["speed_mm_s"] or 0),
            float(params["blend_mm"] or 0),
            int(params["dip_every_strokes"] or 0),
        )

    def dips_before(self, stroke: int) -> bool:
        """Whether the brush dips again before that stroke, counted from 0: the DIP step has served the first."""
        return stroke > 0 and self.dip_every_strokes > 0 and stroke % self.dip_every_strokes == 0


@dataclass(frozen=True, slots=True)
class StrokeMoves:
    """One stroke: single moves to its first point, the way through the others, single moves up from the last."""

    down: list[Move]
    way: list[Pose]
    up: list[Move]
    speed_mm_s: float
    """Along the way."""


def stroke_moves(
    config: RigConfig, plane: PaperPlane, cell: Cell, points: Sequence[TrajectoryPoint], speed_mm_s: float
) -> StrokeMoves:
    """Over the first point with the wrist turned as the stroke begins, tilt just above the paper, land, follow, lift.

    Points are in the cell's frame: origin at its lower left corner, axes along the sheet's.
    """
    motion, paper = config.motion, config.paper

    def at(point: TrajectoryPoint, above_mm: float, tilt_deg: float) -> Pose:
        return plane.pose(
            paper,
            cell.x_mm + point[0],
            cell.y_mm + point[1],
            above_mm,
            tilt_deg=tilt_deg,
            turn_deg=point[4],
        )

    def high(point: TrajectoryPoint) -> Pose:
        base = to_base(paper, cell.x_mm + point[0], cell.y_mm + point[1])
        return brush_pose(*base, motion.safe_z_mm, heading_deg=paper.yaw_deg + point[4])

    def clear(point: TrajectoryPoint) -> float:
        return max(CLEARANCE_MM, CLEARANCE_MM - point[2])

    first, *rest = points
    last = points[-1]
    down = [
        # The wrist turns on the way there, where the brush is upright and turns about itself.
        Move(high(first), motion.travel_speed_mm_s),
        Move(at(first, clear(first), 0.0), motion.travel_speed_mm_s),
        # A turn about the tip that stays where it is: ARCS reads mm/s as thousandths of rad/s.
        Move(at(first, clear(first), first[3]), motion.travel_speed_mm_s),
        Move(at(first, -first[2], first[3]), motion.press_speed_mm_s),
    ]
    up = [
        Move(at(last, clear(last), last[3]), motion.press_speed_mm_s),
        Move(high(last), motion.travel_speed_mm_s),
    ]
    return StrokeMoves(down, [at(point, -point[2], point[3]) for point in rest], up, speed_mm_s)


def check_drawn(config: RigConfig, plane: PaperPlane, limits: Limits, cells: Iterable[Cell], drawn: Drawn) -> None:
    """Check every pose of a figure on these cells. Raises `LimitExceeded`."""
    acc_mm_s2 = config.motion.acc_mm_s2
    for cell in cells:
        for points in drawn.strokes:
            moves = stroke_moves(config, plane, cell, points, drawn.speed_mm_s)
            for move in moves.down + moves.up:
                limits.check("robot", move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=acc_mm_s2)
            for pose in moves.way:
                limits.check("robot", pose, speed_mm_s=moves.speed_mm_s, acc_mm_s2=acc_mm_s2)


async def draw_stroke(
    robot: Robot,
    config: RigConfig,
    plane: PaperPlane,
    cell: Cell,
    points: Sequence[TrajectoryPoint],
    *,
    speed_mm_s: float,
    blend_mm: float,
) -> float:
    """Draw one stroke; begins and ends at safe height. Returns the depth at which the brush landed, in mm.

    All of it is checked before the arm moves. Raises `LimitExceeded` and what `Robot.move` and `Robot.follow` raise.
    """
    acc_mm_s2 = config.motion.acc_mm_s2
    moves = stroke_moves(config, plane, cell, points, speed_mm_s)
    for move in moves.down + moves.up:
        robot.check(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=acc_mm_s2)
    for pose in moves.way:
        robot.check(pose, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)
    for move in moves.down:
        await robot.move(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=acc_mm_s2)
    depth_mm = -plane.above_mm(config.paper, await robot.where())
    await robot.follow(moves.way, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2, blend_mm=blend_mm)
    for move in moves.up:
        await robot.move(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=acc_mm_s2)
    return depth_mm
