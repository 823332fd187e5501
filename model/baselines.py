"""The simple shapes that CCD-BSM is compared with: ellipse, circle and line, each derived from the CCD-BSM mark.

Every baseline takes its sizes from the mark of the same (H, alpha) and is placed on the mark's bounding box in
the frame of `model.raster.frame`, so a score between two models shows a difference of shape, not a shift. The sources
do not define these shapes; each function states the definition chosen and its alternatives, because scores depend
strongly on the choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.outline import Outline, loop


@dataclass(frozen=True, slots=True, eq=False)
class Ellipse:
    """B ellipses with axes along x and y: centre on the x axis and semi-axes in mm, all (B,)."""

    centre_mm: Tensor
    semi_x_mm: Tensor
    semi_y_mm: Tensor

    @property
    def x_min_mm(self) -> Tensor:
        """x of the end on the tip side, (B,)."""
        return self.centre_mm - self.semi_x_mm

    @property
    def x_max_mm(self) -> Tensor:
        """x of the end on the heel side, (B,)."""
        return self.centre_mm + self.semi_x_mm

    @property
    def width_mm(self) -> Tensor:
        """The whole axis along y, (B,)."""
        return 2 * self.semi_y_mm

    @property
    def area_mm2(self) -> Tensor:
        """pi times the product of the semi-axes, (B,)."""
        return math.pi * self.semi_x_mm * self.semi_y_mm

    def outline(self) -> Outline:
        """Four quarters of an ellipse."""
        return rounded(self.centre_mm, self.semi_x_mm, self.semi_y_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """B capsules: segments of half length `reach` dilated by discs of `radius`, mm, all (B,).

    The segment lies along x (`reach_x_mm`) or across it (`reach_y_mm`); the other reach is zero.
    """

    centre_mm: Tensor
    radius_mm: Tensor
    reach_x_mm: Tensor
    reach_y_mm: Tensor

    @property
    def x_min_mm(self) -> Tensor:
        """x of the end on the tip side, (B,)."""
        return self.centre_mm - self.reach_x_mm - self.radius_mm

    @property
    def x_max_mm(self) -> Tensor:
        """x of the end on the heel side, (B,)."""
        return self.centre_mm + self.reach_x_mm + self.radius_mm

    @property
    def width_mm(self) -> Tensor:
        """The whole extent along y, (B,)."""
        return 2 * (self.radius_mm + self.reach_y_mm)

    @property
    def area_mm2(self) -> Tensor:
        """A disc and a rectangle, (B,)."""
        return self.radius_mm * (math.pi * self.radius_mm + 4 * (self.reach_x_mm + self.reach_y_mm))

    def outline(self) -> Outline:
        """Four quarters of a circle and four straight lines, two of them of zero length."""
        r = self.radius_mm
        return rounded(self.centre_mm, self.reach_x_mm + r, self.reach_y_mm + r, r, r)


def ellipse(mark: CcdBsm) -> Ellipse:
    """The bounding ellipse: the mark's length and width, centred on its bounding box.

    Alternatives not taken: the ellipse of equal area on the same length (narrower than the mark), and the
    ellipse of equal centroid and second moments.
    """
    return Ellipse(centre_mm=_centre(mark), semi_x_mm=0.5 * mark.length_mm, semi_y_mm=0.5 * mark.width_mm)


def circle(mark: CcdBsm) -> Ellipse:
    """The circle whose diameter is the mark's length, centred on its bounding box.

    Alternatives not taken: the mark's width as the diameter, and the circle of the mark's area.
    """
    radius = 0.5 * mark.length_mm
    return Ellipse(centre_mm=_centre(mark), semi_x_mm=radius, semi_y_mm=radius)


def line(mark: CcdBsm) -> Capsule:
    """The capsule with the mark's length and width, round ends included in the length.

    A mark that is wider than long (a stubby brush) gives a capsule along y. Alternatives not taken: the
    rectangle of that length and width (butt ends), and round ends added beyond the length.
    """
    half_length, half_width = 0.5 * mark.length_mm, 0.5 * mark.width_mm
    radius = torch.minimum(half_length, half_width)
    return Capsule(
        centre_mm=_centre(mark),
        radius_mm=radius,
        reach_x_mm=half_length - radius,
        reach_y_mm=half_width - radius,
    )


def rounded(
    centre: Tensor, half_x: Tensor, half_y: Tensor, corner_x: Tensor | None = None, corner_y: Tensor | None = None
) -> Outline:
    """A box around (centre, 0) with quarter-ellipse corners, all (B,); an ellipse if no corner sizes are given."""
    ex, ey = half_x if corner_x is None else corner_x, half_y if corner_y is None else corner_y
    x, y, quarter = half_x - ex, half_y - ey, math.sqrt(0.5)
    arcs: list[tuple[list[Tensor], float]] = []
    for k in range(4):
        # Counter-clockwise from the upper right: each corner is a quarter, followed by the line to the next.
        sx, sy = (1, -1, -1, 1)[k], (1, 1, -1, -1)[k]
        nx, ny = (-1, -1, 1, 1)[k], (1, -1, -1, 1)[k]
        side, top = [centre + sx * half_x, sy * y], [centre + sx * x, sy * half_y]
        start, end = (side, top) if k % 2 == 0 else (top, side)
        arcs.append(([*start, centre + sx * half_x, sy * half_y, *end], quarter))
        if corner_x is not None:
            onward = [centre + nx * x, ny * half_y] if k % 2 == 0 else [centre + nx * half_x, ny * y]
            arcs.append(([*end, *(0.5 * (a + b) for a, b in zip(end, onward, strict=True)), *onward], 1.0))
    return loop(*arcs)


def _centre(mark: CcdBsm) -> Tensor:
    return 0.5 * (mark.x_min_mm + mark.x_max_mm)
