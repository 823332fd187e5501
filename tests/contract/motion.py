"""How far and how fast the contract moves an arm: a few millimetres straight up, slowly, and back."""

from __future__ import annotations

import dataclasses

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose

LIFT_MM = 5.0
"""No test sends the tip higher than this above where it stood, lower than that, or sideways."""
SPEED_MM_S = 10.0
SLOW_MM_S = 2.0
"""For a move that is stopped on its way."""
ACC_MM_S2 = 100.0
SAME_PLACE_MM = 0.5
"""Somebody moved the arm between two tests where it stands farther than this from where the first began."""


@dataclasses.dataclass(frozen=True, slots=True)
class Enabled:
    """An arm that may move, where it stands, and the highest pose that a test may send it to."""

    robot: AuboArcs
    start: Pose
    top: Pose


def raised(pose: Pose, by_mm: float) -> Pose:
    """The same attitude, straight above."""
    return dataclasses.replace(pose, z_mm=pose.z_mm + by_mm)
