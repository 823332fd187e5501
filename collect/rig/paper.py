"""The sheet of paper: its patches, its plane, and the transforms between the paper frame and the base frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.errors import SheetFull, StepError
from brushloop.collect.rig.config import PaperConfig
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import Quaternion, brush_pose, of_angles, product, turned, unit

ANCHOR_SHARE = 0.75
"""Place of the zero-touch point along a patch, as a share of its width: the mark extends mostly toward -x."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A patch of paper for one press, in the paper frame."""

    index: int
    x_mm: float
    y_mm: float
    size_x_mm: float
    size_y_mm: float

    @property
    def anchor_mm(self) -> tuple[float, float]:
        """The zero-touch point."""
        return self.x_mm + ANCHOR_SHARE * self.size_x_mm, self.y_mm + 0.5 * self.size_y_mm

    @property
    def rect_mm(self) -> tuple[float, float, float, float]:
        """x, y, width, height."""
        return self.x_mm, self.y_mm, self.size_x_mm, self.size_y_mm


class Sheet:
    """The patches of one sheet, row by row from the far edge, so that the arm never reaches across wet ink."""

    def __init__(self, paper: PaperConfig, cell_mm: tuple[float, float] | None = None) -> None:
        """`cell_mm` is the size that the protocol needs; None is `paper.cell_mm`."""
        self.cell_mm = paper.cell_mm if cell_mm is None else cell_mm
        width, height = paper.size_mm
        cell_w, cell_h = self.cell_mm
        self.columns, self.rows = int(width // cell_w), int(height // cell_h)
        self.capacity = self.columns * self.rows
        """Patches on the sheet."""
        self._left = 0.5 * (width - self.columns * cell_w)
        self._bottom = 0.5 * (height - self.rows * cell_h)

    def patch(self, index: int) -> Patch:
        """The patch with this number."""
        if not 0 <= index < self.capacity:
            raise IndexError(f"patch {index} is outside [0, {self.capacity - 1}]")
        row, column = divmod(index, self.columns)
        cell_w, cell_h = self.cell_mm
        y_mm = self._bottom + (self.rows - 1 - row) * cell_h
        return Patch(index, self._left + column * cell_w, y_mm, cell_w, cell_h)

    def free(self, used: set[int], sheet: int = 1) -> Patch:
        """The first unused patch. Raises `SheetFull`, which names the number `sheet`."""
        for index in range(self.capacity):
            if index not in used:
                return self.patch(index)
        raise SheetFull(self.capacity, sheet)


def to_base(paper: PaperConfig, x_mm: float, y_mm: float) -> tuple[float, float]:
    """A point of the paper frame in the base frame."""
    yaw = math.radians(paper.yaw_deg)
    return (
        paper.origin_mm[0] + math.cos(yaw) * x_mm - math.sin(yaw) * y_mm,
        paper.origin_mm[1] + math.sin(yaw) * x_mm + math.cos(yaw) * y_mm,
    )


MAX_SLOPE_DEG = 3.0
"""A sheet cannot lean more than this: a steeper plane means that something else was touched."""
LEAST_SPREAD_MM = 20.0
"""Touched points must span at least this much in their narrowest direction to give a slope."""


@dataclass(frozen=True, slots=True)
class PaperPlane:
    """The height at which the tip of the vertical brush just touches the sheet: z = z0 + a x + b y, in mm.

    x and y are in the paper frame, z in the base frame.
    """

    z0_mm: float
    slope_x: float = 0.0
    slope_y: float = 0.0

    def touch_z_mm(self, x_mm: float, y_mm: float) -> float:
        """Height of the surface at a point of the sheet, in the base frame."""
        return self.z0_mm + self.slope_x * x_mm + self.slope_y * y_mm

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit vector out of the paper, in the paper frame."""
        length = math.sqrt(1.0 + self.slope_x**2 + self.slope_y**2)
        return -self.slope_x / length, -self.slope_y / length, 1.0 / length

    @property
    def slope_deg(self) -> float:
        """How far the sheet leans from level."""
        return math.degrees(math.atan(math.hypot(self.slope_x, self.slope_y)))

    def above_mm(self, paper: PaperConfig, tip: Pose) -> float:
        """Distance of the tip from the surface along its normal; negative below."""
        x_mm, y_mm = to_paper(paper, tip.x_mm, tip.y_mm)
        return (tip.z_mm - self.touch_z_mm(x_mm, y_mm)) * self.normal[2]

    def pose(
        self,
        paper: PaperConfig,
        x_mm: float,
        y_mm: float,
        above_mm: float,
        *,
        tilt_deg: float = 0.0,
        turn_deg: float = 0.0,
    ) -> Pose:
        """The tip `above_mm` from the point (x, y) of the surface, along the normal (H = -above_mm).

        The ferrule leans by `tilt_deg` from the normal toward `turn_deg`, counter-clockwise from paper x.
        """
        nx, ny, nz = self.normal
        base_x, base_y = to_base(paper, x_mm + above_mm * nx, y_mm + above_mm * ny)
        z_mm = self.touch_z_mm(x_mm, y_mm) + above_mm * nz
        level = brush_pose(base_x, base_y, z_mm, heading_deg=paper.yaw_deg + turn_deg, tilt_deg=tilt_deg)
        if self.slope_x == self.slope_y == 0.0:
            return level
        return Pose(base_x, base_y, z_mm, *product(self._lean(paper), level.quaternion))

    def frame(self, paper: PaperConfig) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
        """Origin in mm and quaternion (x, y, z, w) of the paper frame in the base frame: yaw, then the lean."""
        return (*paper.origin_mm, self.z0_mm), product(self._lean(paper), _yaw(paper))

    def _lean(self, paper: PaperConfig) -> Quaternion:
        """The shortest turn that brings the base's z to the paper's normal."""
        nx, ny, nz = turned(_yaw(paper), self.normal)
        return unit((-ny, nx, 0.0, 1.0 + nz))  # z x n and 1 + z n: half of the angle between them


def _yaw(paper: PaperConfig) -> Quaternion:
    return of_angles(0.0, 0.0, math.radians(paper.yaw_deg))


def fit_plane(points_mm: list[tuple[float, float, float]]) -> tuple[PaperPlane, tuple[float, ...]]:
    """Least squares through touched points (x, y in the paper frame, z in the base frame).

    Returns the plane, and touched minus fitted height of each point: zeros for three, which a plane always fits. One
    or two points give a level plane at their mean height. Raises `StepError` where three or more lie nearly on a line,
    or the plane leans more than a sheet can.
    """
    at: NDArray[np.float64] = np.asarray(points_mm, np.float64)
    if len(points_mm) < 3:
        level = PaperPlane(float(at[:, 2].mean()))
        return level, tuple(float(v) for v in at[:, 2] - level.z0_mm)
    centred = at[:, :2] - at[:, :2].mean(axis=0)
    spread_mm = float(np.linalg.svd(centred, compute_uv=False)[1]) / math.sqrt(len(points_mm)) * 2.0
    if spread_mm < LEAST_SPREAD_MM:
        raise StepError(
            f"the touched points lie within {spread_mm:.1f} mm of a line: they do not show how the sheet leans"
        )
    ones = np.column_stack((np.ones(len(points_mm)), at[:, :2]))
    z0, slope_x, slope_y = (float(v) for v in np.linalg.lstsq(ones, at[:, 2], rcond=None)[0])
    plane = PaperPlane(z0, slope_x, slope_y)
    if plane.slope_deg > MAX_SLOPE_DEG:
        raise StepError(
            f"the sheet would lean by {plane.slope_deg:.1f} deg, limit {MAX_SLOPE_DEG:g}: check what was touched"
        )
    return plane, tuple(float(z - plane.touch_z_mm(x, y)) for x, y, z in points_mm)


def to_paper(paper: PaperConfig, x_mm: float, y_mm: float) -> tuple[float, float]:
    """A point of the base frame in the paper frame, seen from above."""
    yaw = math.radians(paper.yaw_deg)
    dx, dy = x_mm - paper.origin_mm[0], y_mm - paper.origin_mm[1]
    return math.cos(yaw) * dx + math.sin(yaw) * dy, -math.sin(yaw) * dx + math.cos(yaw) * dy
