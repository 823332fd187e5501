"""`Inverter` recovers depth H and tilt alpha from images of presses whose place is known, with intervals and flags.

The shape of a mark does not determine alpha: 1 % error of R or lambda moves it by 4.4 deg. It follows from how far the
mark lies from the zero-touch point.

A fit starts at the press of a table whose area, position and spread are nearest to the image's: from the middle of the
range it can end in a wrong local minimum. It then minimises -log likelihood = (N - P) / 2 log(r'r) + prior / 2, with r
the image less the exact coverage that the model predicts, N pixels and P parameters. So the noise of a pixel is that of
the fit itself. The prior counts as often as a square of `BLOCK_PX` has pixels, because they have one residual in common
where the model is wrong: pixel by pixel, its misfit would outweigh what is known of the place, and move it and alpha.

Intervals allow for residuals that are arbitrarily correlated within squares of `BLOCK_PX`, and independent between
them: the sandwich (J'J)^-1 M (J'J)^-1 with M the sum over squares of (J'r)(J'r)' (K.-Y. Liang and S. Zeger, 1986). That
is for captures, where the model is wrong by more than noise. A mark lies on about ten squares, and so few often show
less variance than there is: a variance is at least that of the posterior with independent pixels, s^2 (J'J)^-1 without
a prior, which holds for a sensor's noise. Errors of R, lambda and scale, which shift every press alike, come on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.model.damped import Equations, Lowest, descend
from brushloop.model.raster import PX_MM, SIZE_PX, coverage
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
Images = NDArray[np.float32]
PARAMETERS = ("depth_mm", "tilt_deg", "x_mm", "y_mm")
"""What a press is recovered in. x and y are the zero-touch point, from the left and top edge: the brush tilts about its
tip, then descends, so the mark's origin lies H tan(alpha) ahead. They move only if the point is uncertain."""
TABLE_DEPTHS, TABLE_TILTS = 32, 7
BLOCK_PX = 16
EDGE_INK = 0.3
"""With more ink than this in a pixel on the image's edge, the mark may continue beyond it."""
MIN_INK_MM2 = 0.5
"""An image with less ink than this has no mark."""
ASIDE_DEG, RIVAL = 10.0, 3.0
"""A fit that starts this far aside in tilt, and ends with at most so many times the squares of the residuals, may be
the true one: models err by as much between conditions. Standard deviations are then no smaller than its distance."""
_FAINT = 0.25  # fainter pixels count as blank in moments: noise far from the mark would outweigh the mark itself
_LEAST_NOISE = 1e-6  # error of the rasteriser in a pixel: a clean image is no more accurate than this
_STEP = np.array([2.0, 4.0, 2.0, 2.0])  # longest step of a parameter
_NUDGE = np.array([1e-3, 5e-3, 1e-3, 1e-3])  # for derivatives
_STILL = np.array([1e-4, 1e-3, 1e-4, 1e-4])  # a step that counts as none
_NEAR = 0.1  # share of a standard deviation: a step that is shorter counts as none, too
_ROUNDS = 60


class Flag(StrEnum):
    """Warning about a recovered press."""

    AT_BOUND = "at_bound"
    """H, alpha or place lies at the limit of its range; its interval is valid on one side at most."""
    UPRIGHT = "upright"
    """alpha is 0, the end of its range: a lean to the other side is a lean at another heading. This is no sign of a bad
    model, as half of all upright presses are recovered with 0. The interval of alpha is valid on one side only."""
    DID_NOT_CONVERGE = "did_not_converge"
    CUT = "cut"
    """The mark reaches the edge of the image; ink beyond it is unknown."""
    BLANK = "blank"
    """Too little ink to be a mark; the values are NaN."""


@dataclass(frozen=True, slots=True)
class Range:
    """Range of depths and tilts to search."""

    depth_mm: tuple[float, float] = (2.0, 30.0)
    tilt_deg: tuple[float, float] = (0.0, 30.0)

    def __post_init__(self) -> None:
        for name, (low, high), least in (("depth_mm", self.depth_mm, 1e-3), ("tilt_deg", self.tilt_deg, 0.0)):
            if not (least <= low < high < math.inf):
                raise ValueError(f"{name} = ({low:g}, {high:g}): expected {least:g} <= low < high")


@dataclass(frozen=True, slots=True)
class Recovered:
    """B recovered presses: `PARAMETERS` as `values` (B, 4) with standard deviations `sigma`, mm and degrees.

    A deviation is 0 for a known value, and NaN where the image does not determine the value.
    """

    values: Floats
    sigma: Floats
    rms: Floats
    """Root mean square of image - predicted, (B,)."""
    flags: tuple[frozenset[Flag], ...]

    @property
    def depth_mm(self) -> Floats:
        """H, (B,)."""
        return self.values[:, 0]

    @property
    def tilt_deg(self) -> Floats:
        """alpha, (B,)."""
        return self.values[:, 1]


@dataclass(frozen=True, slots=True)
class Moments:
    """Moments of B images: area (mm^2), centroid (B, 2) as column and row (mm), and central second moments (B, 3).

    The second moments are xx, xy, yy per area, x along columns, y along rows.
    """

    area: Floats
    centroid: Floats
    second: Floats

    @classmethod
    def of(cls, images: Images, px_mm: float) -> Moments:
        """The moments of (B, N, N) images; blank ones have area 0 and a centroid in the corner."""
        ink = np.where(images > _FAINT, images, 0).astype(np.float64)
        powers = np.vander((np.arange(images.shape[1]) + 0.5) * px_mm, 3, increasing=True)
        sums = np.moveaxis(powers.T @ ink @ powers, 0, -1)  # [p, q, b] is the sum of ink y^p x^q
        (_, x, xx), (y, xy, _), (yy, _, _) = sums / np.maximum(sums[0, 0], 1e-12)
        second = np.stack((xx - x * x, xy - x * y, yy - y * y), axis=-1)
        return cls(sums[0, 0] * px_mm**2, np.stack((x, y), axis=-1), second)

    def spread(self, heading_deg: Floats | float) -> tuple[Floats, Floats]:
        """Standard deviations along and across a heading, mm."""
        c, s = directions(heading_deg).T
        xx, xy, yy = self.second.T
        along = c * c * xx + 2 * c * s * xy + s * s * yy
        return np.sqrt(np.maximum(along, 0)), np.sqrt(np.maximum(xx + yy - along, 0))


def directions(heading_deg: Floats | float) -> Floats:
    """Unit vectors (..., 2) of headings as columns and rows, which grow downwards."""
    turn = np.radians(heading_deg)
    return np.stack((np.cos(turn), -np.sin(turn)), axis=-1)


@dataclass(frozen=True, slots=True)
class Inverter:
    """Recovers presses from images, for one model and raster. Make it once and use it for many images.

    An `anchor_sigma_mm` above 0 is the standard deviation of the zero-touch point along either axis; its place is then
    fitted with that prior. Raises DomainError for a range that the model does not cover.
    """

    model: StrokeModel
    within: Range = field(default_factory=Range)
    size_px: int = SIZE_PX
    px_mm: float = PX_MM
    anchor_sigma_mm: float = 0.0
    table: Floats = field(init=False)
    """(T, 2) depths and tilts that were drawn."""
    drawn: Moments = field(init=False)
    """The moments of their marks, with the zero-touch point at the image's right and lower edge."""

    def __post_init__(self) -> None:
        if not (0 <= self.anchor_sigma_mm < math.inf):
            raise ValueError(f"anchor_sigma_mm = {self.anchor_sigma_mm:g}: expected at least 0")
        depths = np.geomspace(*self.within.depth_mm, TABLE_DEPTHS)
        tilts = np.linspace(*self.within.tilt_deg, TABLE_TILTS)
        table = np.stack(np.meshgrid(depths, tilts, indexing="ij"), axis=-1).reshape(-1, 2)
        # Twice the image's size at half the resolution, so that no mark is cut, wherever its place lies.
        marks = self.predict(np.column_stack((table, np.full_like(table, self.side_mm))), 0.0, 2 * self.px_mm)
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "drawn", Moments.of(marks, 2 * self.px_mm))

    @property
    def side_mm(self) -> float:
        """Side of an image."""
        return self.size_px * self.px_mm

    def __call__(
        self,
        images: NDArray[np.floating[Any]],
        place_mm: Floats | tuple[float, float],
        heading_deg: Floats | float = 0.0,
    ) -> Recovered:
        """Recover the presses of (B, N, N) coverage images, ink = 1.

        `place_mm` (2,) or (B, 2) is the zero-touch point and `heading_deg` the known heading. Raises ValueError for
        images of another size.
        """
        target = np.ascontiguousarray(images, np.float32)
        wanted = (self.size_px, self.size_px)
        if target.ndim != 3 or target.shape[1:] != wanted:
            raise ValueError(f"images are {target.shape}, expected (B, {self.size_px}, {self.size_px})")
        seen = Moments.of(target, self.px_mm)
        place = np.broadcast_to(np.asarray(place_mm, np.float64), (len(target), 2))
        heading = np.broadcast_to(np.asarray(heading_deg, np.float64), (len(target),))
        start = np.column_stack((self._nearest(seen, place, heading), place))
        values, sigma, rms = np.full(start.shape, np.nan), np.full(start.shape, np.nan), np.full(len(start), np.nan)
        flags: list[frozenset[Flag]] = []
        for k, image in enumerate(target):
            alone = set[Flag]()
            if np.concatenate((image[[0, -1]], image[:, [0, -1]].T)).max() > EDGE_INK:
                alone.add(Flag.CUT)
            if seen.area[k] < MIN_INK_MM2:
                alone.add(Flag.BLANK)
            else:
                values[k], sigma[k], rms[k], raised = _Fit(self, image, start[k], heading[k]).run()
                alone |= raised
            flags.append(frozenset(alone))
        return Recovered(values, sigma, rms, tuple(flags))

    def predict(self, values: Floats, heading_deg: Floats | float, px_mm: float) -> Images:
        """Images (B, N, N) of (B, 4) parameters."""
        outlines = self.model.profile(values[:, 0], values[:, 1])
        ahead = values[:, 0] * np.tan(np.radians(values[:, 1]))
        origin = values[:, 2:] + ahead[:, None] * directions(heading_deg)
        return coverage(outlines, origin, heading_deg, size_px=self.size_px, px_mm=px_mm)

    def _nearest(self, seen: Moments, place_mm: Floats, heading_deg: Floats) -> Floats:
        """H and alpha from which B fits start, (B, 2): the press of the table that looks most alike."""
        ahead = np.sum(directions(heading_deg) * (seen.centroid - place_mm), axis=1)
        features = np.sqrt(seen.area), *seen.spread(heading_deg), ahead
        of_table = np.sqrt(self.drawn.area), *self.drawn.spread(0.0), self.drawn.centroid[:, 0] - self.side_mm
        distance = np.square(np.stack(features, -1)[:, None] - np.stack(of_table, -1)[None]).sum(-1)
        best = np.argmin(distance, axis=1)
        # Between two depths of the table, interpolate by area, which grows as H^2.
        depth = self.table[best, 0] * np.sqrt(seen.area / np.maximum(self.drawn.area[best], 1e-12))
        return np.column_stack((depth, self.table[best, 1]))


class _Fit:
    """The fit to one image: of H and alpha, and of the place as well if it is uncertain."""

    def __init__(self, inverter: Inverter, image: Images, start: Floats, heading_deg: float) -> None:
        self._inverter, self._image, self._start, self._heading_deg = inverter, image, start, heading_deg
        side, sigma = inverter.side_mm, inverter.anchor_sigma_mm
        free = 4 if sigma > 0 else 2
        # The place may lie beyond the image on every side.
        limits = (inverter.within.depth_mm, inverter.within.tilt_deg, (-side, 2 * side), (-side, 2 * side))
        self._low, self._high = np.array(limits[:free]).T
        # Residuals are alike within a square, so that all of its pixels together count as one against the prior.
        self._precision = BLOCK_PX**2 * np.array([0.0, 0.0, *[1 / max(sigma, 1e-9) ** 2] * 2])[:free]
        self._step, self._nudge = _STEP[:free], _NUDGE[:free]
        self._degrees = max(image.size - free, 1)

    def run(self) -> tuple[Floats, Floats, float, set[Flag]]:
        """Values (4,), standard deviations (4,), root mean square residual, and flags."""
        free = len(self._step)
        aside = np.outer((0.0, -ASIDE_DEG, ASIDE_DEG), (0.0, 1.0, 0.0, 0.0))
        starts = np.unique(self._clipped((self._start + aside)[:, :free]), axis=0)
        near, *rivals = sorted((self._descend(start, 1e-6) for start in starts), key=lambda end: end.at.cost)
        lowest = self._descend(near.vector, 1e-9)
        residual, jacobian = self._linear(lowest.vector)
        sd = np.sqrt(self._variances(residual, jacobian))
        for rival in rivals:
            if 2.0 * (rival.at.cost - lowest.at.cost) < self._degrees * math.log(RIVAL):
                sd = np.maximum(sd, np.abs(rival.vector - lowest.vector))
        values, sigma = np.append(lowest.vector, self._start[free:]), np.append(sd, np.zeros(4 - free))
        at_limit = (lowest.vector <= self._low) | (lowest.vector >= self._high)
        flags = set[Flag]()
        if at_limit[1] and values[1] == 0.0:
            flags.add(Flag.UPRIGHT)
            at_limit[1] = False
        if at_limit.any():
            flags.add(Flag.AT_BOUND)
        left = np.linalg.lstsq(lowest.at.square, -lowest.at.gradient)[0]
        if (np.abs(self._step * left) > np.maximum(_STILL[:free], _NEAR * sd)).any():
            flags.add(Flag.DID_NOT_CONVERGE)
        return values, sigma, math.sqrt(float(np.mean(np.square(residual)))), flags

    def _descend(self, start: Floats, gain: float) -> Lowest:
        return descend(
            self._equations, start, rounds=_ROUNDS, most=1.0, scale=self._step, gain=gain, feasible=self._clipped
        )

    def _equations(self, vector: Floats) -> Equations:
        """-log likelihood at some values, and its derivatives in steps of `_STEP`."""
        residual, jacobian = self._linear(vector)
        noise = self._noise(residual)
        off, scale = vector - self._start[: len(vector)], self._step
        flat = jacobian.reshape(len(vector), -1)
        square = (flat @ flat.T).astype(np.float64) / noise + np.diag(self._precision)
        gradient = -(flat @ residual.ravel()).astype(np.float64) / noise + self._precision * off
        # A parameter that is pushed against its limit does not move.
        held = ((vector <= self._low) & (gradient > 0)) | ((vector >= self._high) & (gradient < 0))
        square[held], square[:, held], gradient[held] = 0.0, 0.0, 0.0
        cost = 0.5 * self._degrees * math.log(noise) + 0.5 * float(np.sum(self._precision * off**2))
        return Equations(cost, square * np.outer(scale, scale), gradient * scale)

    def _linear(self, vector: Floats) -> tuple[Images, Images]:
        """The residual, image - predicted (N, N), and the derivatives of the prediction (P, N, N)."""
        count, nudges = len(vector), np.diag(self._nudge)
        values = np.repeat(self._start[None], 2 * count + 1, axis=0)
        values[:, :count] = self._clipped(vector + np.vstack((np.zeros(count), nudges, -nudges)))
        drawn = self._inverter.predict(values, self._heading_deg, self._inverter.px_mm)
        ahead, behind = slice(1, count + 1), slice(count + 1, None)
        widths = np.diag(values[ahead, :count] - values[behind, :count]).astype(np.float32)
        return self._image - drawn[0], (drawn[ahead] - drawn[behind]) / widths[:, None, None]

    def _noise(self, residual: Images) -> float:
        """Variance of a pixel."""
        return float(np.sum(np.square(residual), dtype=np.float64)) / self._degrees + _LEAST_NOISE**2

    def _variances(self, residual: Images, jacobian: Images) -> Floats:
        """Of the values, (P,): the sandwich's, or those of the posterior where these are greater.

        NaN where the image does not determine the values.
        """
        noise = self._noise(residual)
        flat = jacobian.reshape(len(jacobian), -1).astype(np.float64)
        bread = _inverse(flat @ flat.T + noise * np.diag(self._precision))
        starts = np.arange(0, len(residual), BLOCK_PX)
        blocks = np.add.reduceat(np.add.reduceat(jacobian * residual, starts, axis=1), starts, axis=2)
        sums = blocks.reshape(len(jacobian), -1).astype(np.float64)
        # Only blocks on the boundary carry information: about as many as lie along two sides of the image.
        few = 2 * len(starts) / max(2 * len(starts) - 1, 1)
        prior = (noise * BLOCK_PX) ** 2 * np.diag(self._precision)
        sandwich = bread @ (few * sums @ sums.T + prior) @ bread
        return np.maximum(np.diag(sandwich), noise * np.diag(bread))

    def _clipped(self, vector: Floats) -> Floats:
        return np.clip(vector, self._low, self._high)


def _inverse(matrix: Floats) -> Floats:
    """The inverse, scaled to a unit diagonal first; NaN for a matrix that is singular to rounding."""
    scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    unit = matrix / np.outer(scale, scale)
    if np.linalg.eigvalsh(unit)[0] <= 1e-12:
        return np.full(matrix.shape, np.nan)
    return np.linalg.inv(unit) / np.outer(scale, scale)
