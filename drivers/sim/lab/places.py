"""Where the things of a lab are, as poses of the true tip, and how a person holds the brush there."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.config import Table

Place = tuple[float, float, float]
"""x, y, z in the base frame, in mm."""
CORNERS = ("lower left", "lower right", "upper right", "upper left")
"""Of the board and of the sheet, with the print upright before the reader."""


def in_base(table: Table, x_mm: float, y_mm: float, above_mm: float = 0.0) -> Place:
    """A point of the paper frame, `above_mm` above the sheet's plane."""
    yaw = math.radians(table.yaw_deg)
    return (
        table.origin_mm[0] + math.cos(yaw) * x_mm - math.sin(yaw) * y_mm,
        table.origin_mm[1] + math.sin(yaw) * x_mm + math.cos(yaw) * y_mm,
        table.surface_z_mm(x_mm, y_mm) + above_mm,
    )


def over_sheet(table: Table, above_mm: float = 0.0) -> Place:
    """The middle of the sheet, or a place above it."""
    width, height = table.sheet_mm
    return in_base(table, width / 2, height / 2, above_mm)


def board_size_mm(table: Table) -> tuple[float, float]:
    """True width and height of the printed board."""
    columns, rows = table.board_squares
    return columns * table.board_square_mm, rows * table.board_square_mm


def corner(table: Table, of: str, name: str) -> Place:
    """A corner of the `board` or of the `sheet`. Raises ValueError for an unknown name."""
    if name not in CORNERS:
        raise ValueError(f"corner = {name!r} is not one of {', '.join(CORNERS)}")
    left, bottom = table.board_origin_mm if of == "board" else (0.0, 0.0)
    width, height = board_size_mm(table) if of == "board" else table.sheet_mm
    return in_base(table, left + width * ("right" in name), bottom + height * ("upper" in name))


def held(place: Place, *, wrist_deg: float, tilt_deg: float = 0.0, toward_deg: float = 0.0) -> Pose:
    """The brush with its tip at a place, its wrist turned, and then its ferrule leaned toward a direction.

    Unlike `brush_pose`, where the wrist turns with the direction of the lean.
    """
    toward = math.radians(toward_deg)
    lean = Rotation.from_rotvec(math.radians(tilt_deg) * np.array([-math.sin(toward), math.cos(toward), 0.0]))
    upright = Rotation.from_euler("z", wrist_deg, degrees=True) * Rotation.from_rotvec([math.pi, 0.0, 0.0])
    qx, qy, qz, qw = (float(v) for v in (lean * upright).as_quat())
    return Pose(*place, qx, qy, qz, qw)


def shifted(pose: Pose, shift_mm: Place) -> Pose:
    """The same orientation at another place."""
    x, y, z = (a + b for a, b in zip(pose.position_mm, shift_mm, strict=True))
    return Pose(x, y, z, *pose.quaternion)


def withdrawn(pose: Pose, mm: float) -> Pose:
    """The tip drawn back along the brush."""
    x, y, z = (float(v) for v in Rotation.from_quat(pose.quaternion).apply([0.0, 0.0, -mm]))
    return shifted(pose, (x, y, z))


def azimuth_deg(place: Place) -> float:
    """Direction from the foot of the arm, in which a person would turn the wrist."""
    return math.degrees(math.atan2(place[1], place[0]))
