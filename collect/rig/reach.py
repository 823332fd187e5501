"""How far the arm reaches, from the nominal dimensions of the i5. The controller of a real arm has its own, calibrated
ones: what lies within a few millimetres of the limit must be asked of it (`collect plan --ask`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from collect.rig.config_devices import RobotConfig
from drivers.geometry import brush_pose, from_wire
from drivers.rotation import inverse, product, turned
from drivers.samples import Pose

SHOULDER_MM = 122.0
"""Height of the shoulder's axis above the base, from the maker's table of modified DH parameters, as all of these."""
UPPER_ARM_MM, FOREARM_MM = 408.0, 376.0
SIDEWAYS_MM = 121.5
"""Distance of the plane in which upper arm and forearm move from the axis of the base."""
WRIST_MM, FLANGE_MM = 102.5, 94.0
ELBOW_DEG = 175.0
"""Largest angle by which the elbow bends to either side."""
STRETCHED_MM = UPPER_ARM_MM + FOREARM_MM
FOLDED_MM = math.sqrt(
    UPPER_ARM_MM**2 + FOREARM_MM**2 - 2.0 * UPPER_ARM_MM * FOREARM_MM * math.cos(math.radians(180.0 - ELBOW_DEG))
)
"""Least distance from shoulder to wrist, with the elbow bent as far as it goes."""
BOTH = (1.0, -1.0)
Vector = NDArray[np.float64]


def tool_of(robot: RobotConfig) -> Pose:
    """The brush's frame at its tip, in the flange's frame."""
    return from_wire([*(v / 1e3 for v in robot.tcp_offset_mm), *map(math.radians, robot.tcp_rotation_deg)])


def _wrist_and_axis(tip: Pose, tool: Pose) -> tuple[Vector, Vector]:
    """(where the wrist's last two axes meet in mm, direction of the flange's axis) in the base frame."""
    flange = product(tip.quaternion, inverse(tool.quaternion))
    along = np.array(turned(flange, (0.0, 0.0, 1.0)))
    return np.array(tip.position_mm) - turned(flange, tool.position_mm) - FLANGE_MM * along, along


def reach_left_mm(tip: Pose, tool: Pose) -> float:
    """How much farther the wrist could be from the shoulder, in the best of the arm's postures, in mm.

    Negative if the pose is out of reach: too far, or too near the base. `tool` is the tip's frame in the flange's.
    Collisions and the limits of the other joints are not considered.
    """
    wrist, along = _wrist_and_axis(tip, tool)
    out_mm = math.hypot(wrist[0], wrist[1])
    if out_mm <= SIDEWAYS_MM:
        return out_mm - SIDEWAYS_MM
    best_mm = -math.inf
    for side, way in itertools.product(BOTH, BOTH):
        # The direction of the axes of shoulder, elbow and first wrist joint, which are parallel and level.
        heading = math.atan2(wrist[1], wrist[0]) + side * math.acos(SIDEWAYS_MM / out_mm)
        level = np.array([math.cos(heading), math.sin(heading), 0.0])
        across = np.cross(level, along)
        if (length := float(np.linalg.norm(across))) < 1e-9:
            continue  # the tool lies along those axes
        elbow_to = wrist - way * WRIST_MM * across / length
        distance_mm = float(np.linalg.norm(elbow_to - SIDEWAYS_MM * level - [0.0, 0.0, SHOULDER_MM]))
        best_mm = max(best_mm, min(STRETCHED_MM - distance_mm, distance_mm - FOLDED_MM))
    return best_mm


@dataclass(frozen=True, slots=True)
class Ring:
    """Where the upright tip can be at one height, seen from above."""

    centre_mm: tuple[float, float]
    """In the base frame; beside the base's axis if the tip is beside the flange's."""
    least_mm: float
    most_mm: float


def upright_ring(z_mm: float, heading_deg: float, tool: Pose) -> Ring | None:
    """The ring that the upright tip reaches at a height of the base frame; None if it reaches nothing there."""
    wrist, _ = _wrist_and_axis(brush_pose(0.0, 0.0, z_mm, heading_deg=heading_deg), tool)
    rise_mm = float(wrist[2]) - SHOULDER_MM
    if abs(rise_mm) >= STRETCHED_MM:
        return None
    far_mm = math.sqrt(STRETCHED_MM**2 - rise_mm**2) + WRIST_MM
    near_mm = max(math.sqrt(max(FOLDED_MM**2 - rise_mm**2, 0.0)) - WRIST_MM, 0.0)
    centre = (-float(wrist[0]), -float(wrist[1]))
    return Ring(centre, math.hypot(near_mm, SIDEWAYS_MM), math.hypot(far_mm, SIDEWAYS_MM))
