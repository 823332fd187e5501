"""Starting point of a fit: the press in a table whose area, position and spread are nearest to the image's.

From the middle of the range a fit can end in a wrong local minimum; area (A ~ H^2) and moments avoid this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.model.inversion.forward import Forward, Images

Floats = NDArray[np.float64]
MIN_INK_MM2 = 0.5
"""An image with less ink than this has no mark."""


@dataclass(frozen=True, slots=True)
class Moments:
    """Moments of B images: area (mm^2), centroid (B, 2) as column and row (mm), and central second and third moments.

    second (B, 3) holds xx, xy, yy and third (B, 4) xxx, xxy, xyy, yyy, both per area, x along columns, y along rows.
    """

    area: Floats
    centroid: Floats
    second: Floats
    third: Floats

    def heading_deg(self) -> Floats:
        """Direction of the thick end, (B,): along the longer axis, away from the long thin tail."""
        xx, xy, yy = self.second.T
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        c, s = np.cos(angle), np.sin(angle)
        xxx, xxy, xyy, yyy = self.third.T
        skew = c**3 * xxx + 3 * c * c * s * xxy + 3 * c * s * s * xyy + s**3 * yyy
        # Rows grow downwards, headings counter-clockwise.
        return -np.degrees(np.where(skew > 0, angle + np.pi, angle))

    def spread(self, heading_deg: Floats) -> tuple[Floats, Floats]:
        """Standard deviations along and across a heading, mm."""
        c, s = np.cos(np.radians(heading_deg)), -np.sin(np.radians(heading_deg))
        xx, xy, yy = self.second.T
        along = c * c * xx + 2 * c * s * xy + s * s * yy
        return np.sqrt(np.maximum(along, 0)), np.sqrt(np.maximum(xx + yy - along, 0))


def moments_of(images: Images, px_mm: float) -> Moments:
    """The moments of (B, N, N) images; blank ones have area 0 and a centroid in the corner."""
    from brushloop.model.inversion.kernel import moments

    sums = np.empty((len(images), 10))
    moments(images, sums)
    area = np.maximum(sums[:, 0], 1e-12)
    x, y = sums[:, 1] / area, sums[:, 2] / area
    exx, exy, eyy = (sums[:, k] / area for k in (3, 4, 5))
    exxx, exxy, exyy, eyyy = (sums[:, k] / area for k in (6, 7, 8, 9))
    second = np.stack((exx - x * x, exy - x * y, eyy - y * y), axis=-1)
    third = (
        exxx - 3 * x * exx + 2 * x**3,
        exxy - 2 * x * exy - y * exx + 2 * x * x * y,
        exyy - 2 * y * exy - x * eyy + 2 * x * y * y,
        eyyy - 3 * y * eyy + 2 * y**3,
    )
    return Moments(
        sums[:, 0] * px_mm**2, np.stack((x, y), axis=-1) * px_mm, second * px_mm**2, np.stack(third, axis=-1) * px_mm**3
    )


@dataclass(frozen=True, slots=True)
class Table:
    """T presses of a model, drawn with the origin (or anchor) at `place_mm` and heading 0."""

    depth_mm: Floats
    tilt_deg: Floats
    place_mm: tuple[float, float]
    made: Moments

    @classmethod
    def of(
        cls, forward: Forward, depths_mm: Floats, tilts_deg: Floats, place_mm: tuple[float, float], px_mm: float
    ) -> Table:
        """Draw every depth at every tilt with a forward model of (H, alpha)."""
        height, tilt = (grid.ravel() for grid in np.meshgrid(depths_mm, tilts_deg, indexing="ij"))
        return cls(height, tilt, place_mm, moments_of(forward.predict(np.column_stack((height, tilt))), px_mm))

    def nearest(self, seen: Moments, place_mm: Floats | None, heading_deg: Floats) -> Floats:
        """Starting points (H, alpha, x, y) of B fits, (B, 4). `place_mm` (B, 2): the origin, if known."""
        along, across = seen.spread(heading_deg)
        features = [np.sqrt(seen.area), along, across]
        mine = [np.sqrt(self.made.area), *self.made.spread(np.zeros(len(self.depth_mm)))]
        ahead = self.made.centroid[:, 0] - self.place_mm[0]
        c, s = np.cos(np.radians(heading_deg)), -np.sin(np.radians(heading_deg))
        if place_mm is not None:
            features.append(c * (seen.centroid[:, 0] - place_mm[:, 0]) + s * (seen.centroid[:, 1] - place_mm[:, 1]))
            mine.append(ahead)
        distance = np.square(np.stack(features, -1)[:, None] - np.stack(mine, -1)[None]).sum(-1)
        best = np.argmin(distance, axis=1)
        # Between two depths of the table, interpolate by area, which grows as H^2.
        height = self.depth_mm[best] * np.sqrt(seen.area / np.maximum(self.made.area[best], 1e-12))
        if place_mm is None:
            reach = ahead[best] * height / self.depth_mm[best]
            place_mm = seen.centroid - reach[:, None] * np.stack((c, s), axis=-1)
        return np.column_stack((height, self.tilt_deg[best], place_mm))
