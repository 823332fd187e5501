"""The forward model of a fit: images of presses, and the normal equations of a batch of them at given parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from brushloop.model.inversion.jets import Jets

Floats = NDArray[np.float64]
Images = NDArray[np.float32]
Rows = NDArray[np.int64]
PARAMETERS: tuple[str, ...] = ("depth_mm", "tilt_deg", "x_mm", "y_mm", "heading_deg")
BLOCK_PX = 16
"""Side of the squares within which residuals may be correlated."""


@dataclass(frozen=True, slots=True)
class Normal:
    """Sums over the pixels of B images, J the Jacobian in P parameters and r = target - predicted."""

    hessian: Floats
    """J J', (B, P, P)."""
    gradient: Floats
    """J r, (B, P)."""
    cost: Floats
    """r r, (B,)."""
    meat: Floats
    """Sum over blocks of (J r)(J r)', (B, P, P): the covariance of J r if only blocks are independent."""
    cut: Floats
    """The most ink in a pixel on the target's edge, (B,)."""


class Forward(Protocol):
    """Interface of a model to the fit."""

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters in order, a subset of `PARAMETERS`."""
        ...

    def of(self, images: Rows) -> Forward:
        """Restrict the model, with the known values of each image, to these images of a batch."""
        ...

    def predict(self, values: Floats) -> Images:
        """Images of (B, P) parameters, (B, N, N)."""
        ...

    def normal(self, values: Floats, target: Images, row: Rows) -> Normal:
        """The normal equations at (B, P) parameters, image n against target[row[n]]."""
        ...


@dataclass(frozen=True, slots=True)
class Outlines:
    """Outlines on the exact raster. Of the five parameters, those in `names` are free; the others are fixed at `held`
    (B, 5), or (1, 5) for all.

    With `anchored`, x and y are the zero-touch point, which lies H tan(alpha) behind the stroke's origin: the brush
    tilts about its tip, then descends.
    """

    jets: Jets
    names: tuple[str, ...]
    held: Floats
    anchored: bool
    size_px: int
    px_mm: float

    def of(self, images: Rows) -> Outlines:
        """See `Forward`."""
        return replace(self, held=self.held[images])

    def predict(self, values: Floats) -> Images:
        """See `Forward`."""
        points, weights, _, _ = self._placed(values, derivatives=False)
        return self._draw(points, weights)

    def normal(self, values: Floats, target: Images, row: Rows) -> Normal:
        """See `Forward`."""
        from brushloop.model.inversion.kernel import normal_equations

        points, weights, velocities, rates = self._placed(values, derivatives=True)
        count, free = len(values), len(self.names)
        square = (count, free, free)
        sums = Normal(*(np.empty(shape) for shape in (square, (count, free), count, square, count)))
        predicted = self._draw(points, weights)
        normal_equations(
            points, weights, velocities, rates, predicted, target, BLOCK_PX, row,
            sums.hessian, sums.gradient, sums.cost, sums.meat, sums.cut,
        )  # fmt: skip
        return sums

    def _draw(self, points: Floats, weights: Floats) -> Images:
        from brushloop.model.raster.kernel import rasterise

        out = np.empty((len(points), self.size_px, self.size_px), np.float32)
        same = np.zeros((len(points), 6))
        same[:, 0] = same[:, 4] = 1.0
        rasterise(points, weights, same, out)
        return out

    def _placed(self, values: Floats, *, derivatives: bool) -> tuple[Floats, Floats, Floats, Floats]:
        """Outlines in pixels with derivatives with respect to the free parameters; `model.raster.frame` has the map."""
        full = np.repeat(self.held, len(values) // len(self.held), axis=0)
        full[:, [PARAMETERS.index(name) for name in self.names]] = values
        height, tilt, x, y, heading = full.T
        jet = self.jets(height, tilt)
        points, velocities = jet.points, jet.velocities
        if self.anchored:
            alpha = np.radians(tilt)
            points, velocities = points.copy(), velocities.copy()
            points[..., 0] += (height * np.tan(alpha))[:, None, None]
            velocities[:, 0, ..., 0] += np.tan(alpha)[:, None, None]
            velocities[:, 1, ..., 0] += (height * np.radians(1.0) / np.cos(alpha) ** 2)[:, None, None]
        c, s = np.cos(np.radians(heading)), np.sin(np.radians(heading))
        # For row vectors: (x, y) of the stroke times this matrix is (column, row), in pixels.
        turn = np.array([[c, -s], [-s, -c]]).transpose(2, 0, 1) / self.px_mm
        drawn = np.einsum("bkpc,bcd->bkpd", points, turn)
        place = np.stack((x, y), axis=-1)[:, None, None] / self.px_mm
        moved = np.zeros((len(values), len(self.names), *points.shape[1:]))
        rates = np.zeros((len(values), len(self.names), points.shape[1]))
        if derivatives:
            for k, name in enumerate(self.names):
                which = PARAMETERS.index(name)
                if which < 2:
                    moved[:, k] = np.einsum("bkpc,bcd->bkpd", velocities[:, which], turn)
                    rates[:, k] = jet.rates[:, which]
                elif which < 4:
                    moved[:, k, ..., which - 2] = 1 / self.px_mm
                else:
                    moved[:, k, ..., 0] = np.radians(1.0) * drawn[..., 1]
                    moved[:, k, ..., 1] = -np.radians(1.0) * drawn[..., 0]
        return drawn + place, jet.weights, moved, rates
