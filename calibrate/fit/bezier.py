"""The Bezier stroke regressed on a brush's own captures: the fair peer of a fitted model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.fit.fit import Grid, Pressed
from model.outline import Shape
from model.raster.compiled import coverage_numpy
from model.regression import Plane, fit_plane
from model.strokes.bezier import bezier

TIP_SHARE = 0.9
"""Where the shape's own origin lies along it; moved by as much when drawn, so any share gives the same mark."""


@dataclass(frozen=True, slots=True)
class RefittedBezier:
    """Ends, belly and shoulder as planes in (H, H alpha), as the paper's Bezier baseline has them."""

    plane: Plane

    def mark(self, height_mm: float, tilt_deg: float) -> tuple[Shape, float]:
        """The stroke, and where its origin lies from the point of touch, mm."""
        import torch

        left, right, belly, shoulder = (float(v) for v in self.plane.at(height_mm, tilt_deg).values())
        length = max(right - left, 0.2)
        values = {
            "tip_mm": TIP_SHARE * length,
            "base_mm": (1 - TIP_SHARE) * length,
            "belly_mm": max(belly, 0.1),
            "shoulder": min(max(shoulder, 0.0), 1.0),
        }
        shape = bezier({name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()})
        return shape, left + TIP_SHARE * length

    def image(self, height_mm: float, tilt_deg: float, grid: Grid) -> np.ndarray:
        """Coverage (len(y_mm), len(x_mm)) on the grid."""
        shape, origin_mm = self.mark(height_mm, tilt_deg)
        corner = (grid.x_mm[0] - 0.5 * grid.px_mm, grid.y_mm[0] + 0.5 * grid.px_mm)
        origin = (origin_mm - corner[0], corner[1])
        side = max(len(grid.x_mm), len(grid.y_mm))
        image = coverage_numpy(shape, origin, size_px=side, px_mm=grid.px_mm, threads=1)[0]
        return image[: len(grid.y_mm), : len(grid.x_mm)]


def refit_bezier(strokes: Sequence[Pressed], grid: Grid) -> RefittedBezier:
    """Measure each stroke's ends, width and area, and regress. Raises ValueError where the cells span no plane."""
    import torch

    rows: list[tuple[float, float, float, float]] = []
    for stroke in strokes:
        ink = stroke.ink > 0.5
        columns = np.flatnonzero(ink.any(axis=0))
        if not len(columns):
            raise ValueError("a stroke without ink cannot be measured")
        left = float(grid.x_mm[columns[0]]) - 0.5 * grid.px_mm
        right = float(grid.x_mm[columns[-1]]) + 0.5 * grid.px_mm
        width = float(stroke.ink.sum(axis=0).max()) * grid.px_mm
        # The enclosed area is belly length (4 - s) / 5, as in `model.strokes.bezier`.
        area = float(stroke.ink.sum()) * grid.px_mm**2
        rows.append((left, right, width, float(np.clip(4.0 - 5.0 * area / (width * (right - left)), 0.0, 1.0))))
    table = torch.tensor(rows, dtype=torch.float64)
    names = ("left_mm", "right_mm", "belly_mm", "shoulder")
    height = torch.tensor([s.height_mm for s in strokes], dtype=torch.float64)
    tilt = torch.tensor([s.tilt_deg for s in strokes], dtype=torch.float64)
    return RefittedBezier(fit_plane(height, tilt, dict(zip(names, table.T, strict=True))))
