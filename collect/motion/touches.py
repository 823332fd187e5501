"""Where touches and the self-check send the brush: the same lists for the plan that checks them and the run."""

from __future__ import annotations

from dataclasses import dataclass

from collect.motion.procedures import CLEARANCE_MM, Move
from collect.rig.config import RigConfig
from collect.rig.paper import PaperPlane, to_base
from drivers.geometry import brush_pose
from drivers.samples import Pose

CHECK_APPROACH_MM = 4.0
"""Height above the paper at which the slow approach of a self-check's mark begins."""
CHECK_SPEED_MM_S = 5.0
"""Of that approach."""


@dataclass(frozen=True, slots=True)
class Room:
    """Where a touch may send the upright brush as it finds out: any pose between these, its outermost ones."""

    poses: tuple[Pose, ...]
    """The lowest first."""
    speed_mm_s: float
    """No move within is faster."""

    @classmethod
    def over(
        cls, config: RigConfig, rect_mm: tuple[float, float, float, float], lowest_z_mm: float, speed_mm_s: float
    ) -> Room:
        """Over a rectangle of the sheet (x, y, width, height), which may be a point, up to travel height."""
        x_mm, y_mm, width_mm, height_mm = rect_mm
        places = dict.fromkeys((x, y) for x in (x_mm, x_mm + width_mm) for y in (y_mm, y_mm + height_mm))
        heights = (lowest_z_mm, config.motion.safe_z_mm)
        return cls(tuple(upright(config, *place, z_mm) for z_mm in heights for place in places), speed_mm_s)


def upright(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    """The upright brush over a point of the sheet, its tip at a height of the base frame, at travel height at most."""
    base_x, base_y = to_base(config.paper, x_mm, y_mm)
    return brush_pose(base_x, base_y, min(z_mm, config.motion.safe_z_mm), heading_deg=config.paper.yaw_deg)


def over(config: RigConfig, x_mm: float, y_mm: float) -> Move:
    """To travel height over a point."""
    return Move(upright(config, x_mm, y_mm, config.motion.safe_z_mm), config.motion.travel_speed_mm_s)


def near(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Move:
    """From travel height down to where a slow approach begins."""
    return Move(upright(config, x_mm, y_mm, z_mm), config.motion.press_speed_mm_s)


def up(config: RigConfig, x_mm: float, y_mm: float) -> Move:
    """From a touch up to travel height over its point."""
    return Move(upright(config, x_mm, y_mm, config.motion.safe_z_mm), config.motion.press_speed_mm_s)


def lift(config: RigConfig, here: Pose) -> list[Move]:
    """Straight up to travel height from wherever the tip is; nothing where it is there."""
    up = Pose(here.x_mm, here.y_mm, config.motion.safe_z_mm, *here.quaternion)
    return [Move(up, config.motion.press_speed_mm_s)] if here.z_mm < config.motion.safe_z_mm else []


def visit_moves(config: RigConfig, plane: PaperPlane, x_mm: float, y_mm: float) -> list[Move]:
    """Over a point of the sheet, down to clearance, slowly to where the surface is thought to be, and up."""
    motion, paper = config.motion, config.paper
    above = over(config, x_mm, y_mm)
    return [
        above,
        Move(plane.pose(paper, x_mm, y_mm, CLEARANCE_MM), motion.travel_speed_mm_s),
        Move(plane.pose(paper, x_mm, y_mm, 0.0), motion.press_speed_mm_s / 4),
        above,
    ]


def mark_moves(config: RigConfig, plane: PaperPlane, x_mm: float, y_mm: float) -> list[Move]:
    """A mark of the self-check: over the place, near; then, as one, slowly to its depth and up."""
    surface_z_mm = plane.touch_z_mm(x_mm, y_mm)
    down = near(config, x_mm, y_mm, surface_z_mm + CHECK_APPROACH_MM)
    mark = Move(upright(config, x_mm, y_mm, surface_z_mm - config.self_check.depth_mm), CHECK_SPEED_MM_S)
    return [over(config, x_mm, y_mm), down, mark, up(config, x_mm, y_mm)]
