"""`Inverter` recovers depth H, tilt alpha and place from images of presses, each with its interval and flags.

A fit starts at the press of a table whose area, position and spread are nearest to the image's: from the middle of the
range it can end in a wrong local minimum. It then minimises -log likelihood = (N - P) / 2 log(r'r) + prior / 2, with r
the image less the exact coverage that the model predicts, N pixels and P parameters. So the noise of a pixel is that of
the fit itself, and a prior has the right weight at any noise.

Intervals allow for residuals that are arbitrarily correlated within squares of `BLOCK_PX`, and independent between
them: the sandwich (J'J)^-1 M (J'J)^-1 with M the sum over squares of (J'r)(J'r)' (K.-Y. Liang and S. Zeger, 1986). That
is for captures, where the model is wrong by more than noise. A mark lies on about ten squares, and so few often show
less variance than there is: a variance is at least that of the posterior with independent pixels, s^2 (J'J)^-1 without
a prior, which holds for a sensor's noise. They do not include errors of the brush's R, of lambda, or of the scale:
these shift every press of a session alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.model.damped import Equations, descend
from brushloop.model.raster import PX_MM, SIZE_PX, coverage
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
Images = NDArray[np.float32]
PARAMETERS = ("depth_mm", "tilt_deg", "x_mm", "y_mm", "heading_deg")
"""What a press may be recovered in. x and y are the zero-touch point, from the left and top edge: the brush tilts about
its tip, then descends, so the mark's origin lies H tan(alpha) ahead."""
TABLE_DEPTHS, TABLE_TILTS = 32, 7
BLOCK_PX = 16
EDGE_INK = 0.3
"""With more ink than this in a pixel on the image's edge, the mark may continue beyond it."""
MIN_INK_MM2 = 0.5
"""An image with less ink than this has no mark."""
_FAINT = 0.25  # fainter pixels count as blank in moments: noise far from the mark would outweigh the mark itself
_LEAST_NOISE = 1e-6  # error of the rasteriser in a pixel: a clean image is no more accurate than this
_STEP = np.array([2.0, 4.0, 2.0, 2.0, 10.0])  # longest step of a parameter
_NUDGE = np.array([1e-3, 5e-3, 1e-3, 1e-3, 1e-2])  # for derivatives
_STILL = np.array([1e-4, 1e-3, 1e-4, 1e-4, 1e-3])  # a step that counts as none
_NEAR = 0.1  # share of a standard deviation: a step that is shorter counts as none, too
_ROUNDS = 60


class Flag(StrEnum):
    """Warning about a recovered press."""

    ALPHA_UNKNOWN = "alpha_unknown"
    """No zero-touch anchor: shape does not determine alpha, since 1 % error of R or lambda moves it by 4.4 deg."""
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
    """B recovered presses. `values` (B, 5) are the `PARAMETERS`, mm and degrees.

    `sigma` are standard deviations, 0 for known values and NaN where the image does not determine the value.
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
        """alpha, (B,). Check the flags before using it."""
        return self.values[:, 1]

    def interval(self, name: str, z: float = 1.96) -> tuple[Floats, Floats]:
        """Ends of the interval of a parameter, (B,) each; z = 1.96 covers 95 % of a normal distribution."""
        k = PARAMETERS.index(name)
        return self.values[:, k] - z * self.sigma[:, k], self.values[:, k] + z * self.sigma[:, k]


@dataclass(frozen=True, slots=True)
class Moments:
    """Moments of B images: area (mm^2), centroid (B, 2) as column and row (mm), and central second and third moments.

    second (B, 3) holds xx, xy, yy and third (B, 4) xxx, xxy, xyy, yyy, both per area, x along columns, y along rows.
    """

    area: Floats
    centroid: Floats
    second: Floats
    third: Floats

    @classmethod
    def of(cls, images: Images, px_mm: float) -> Moments:
        """The moments of (B, N, N) images; blank ones have area 0 and a centroid in the corner."""
        ink = np.where(images > _FAINT, images, 0).astype(np.float64)
        powers = np.vander((np.arange(images.shape[1]) + 0.5) * px_mm, 4, increasing=True)
        sums = powers.T @ ink @ powers  # [b, p, q] is the sum of ink y^p x^q
        sums = np.moveaxis(sums, 0, -1)
        area = np.maximum(sums[0, 0], 1e-12)
        (_, x, xx, xxx), (y, xy, xxy, _), (yy, xyy, _, _), (yyy, *_) = sums / area
        second = (xx - x * x, xy - x * y, yy - y * y)
        third = (
            xxx - 3 * x * xx + 2 * x**3,
            xxy - 2 * x * xy - y * xx + 2 * x * x * y,
            xyy - 2 * y * xy - x * yy + 2 * x * y * y,
            yyy - 3 * y * yy + 2 * y**3,
        )
        return cls(sums[0, 0] * px_mm**2, *(np.stack(parts, axis=-1) for parts in ((x, y), second, third)))

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
        c, s = directions(heading_deg).T
        xx, xy, yy = self.second.T
        along = c * c * xx + 2 * c * s * xy + s * s * yy
        return np.sqrt(np.maximum(along, 0)), np.sqrt(np.maximum(xx + yy - along, 0))


def directions(heading_deg: Floats) -> Floats:
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
        depths, tilts = (
            np.geomspace(*self.within.depth_mm, TABLE_DEPTHS),
            np.linspace(*self.within.tilt_deg, TABLE_TILTS),
        )
        table = np.stack(np.meshgrid(depths, tilts, indexing="ij"), axis=-1).reshape(-1, 2)
        places = np.broadcast_to([self.side_mm, self.side_mm, 0.0], (len(table), 3))
        # Twice the image's size at half the resolution, so that no mark is cut, wherever its place lies.
        marks = self.predict(np.column_stack((table, places)), 2 * self.px_mm)
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "drawn", Moments.of(marks, 2 * self.px_mm))

    @property
    def side_mm(self) -> float:
        """Side of an image."""
        return self.size_px * self.px_mm

    def __call__(
        self,
        images: NDArray[np.floating[Any]],
        place_mm: Floats | tuple[float, float] | None = None,
        heading_deg: Floats | float = 0.0,
    ) -> Recovered:
        """Recover the presses of (B, N, N) coverage images, ink = 1.

        `place_mm` (2,) or (B, 2) is the zero-touch point and `heading_deg` the known heading; without a place, both are
        recovered from the mark as well. Raises ValueError for images of another size.
        """
        target = np.ascontiguousarray(images, np.float32)
        wanted = (self.size_px, self.size_px)
        if target.ndim != 3 or target.shape[1:] != wanted:
            raise ValueError(f"images are {target.shape}, expected (B, {self.size_px}, {self.size_px})")
        seen = Moments.of(target, self.px_mm)
        if place_mm is None:
            heading = seen.heading_deg()
        else:
            place_mm = np.broadcast_to(np.asarray(place_mm, np.float64), (len(target), 2))
            heading = np.broadcast_to(np.asarray(heading_deg, np.float64), (len(target),))
        start = np.column_stack((self._nearest(seen, place_mm, heading), heading))
        values, sigma, rms = np.full(start.shape, np.nan), np.full(start.shape, np.nan), np.full(len(start), np.nan)
        flags: list[frozenset[Flag]] = []
        for k, image in enumerate(target):
            alone = {Flag.ALPHA_UNKNOWN} if place_mm is None else set[Flag]()
            if np.concatenate((image[[0, -1]], image[:, [0, -1]].T)).max() > EDGE_INK:
                alone.add(Flag.CUT)
            if seen.area[k] < MIN_INK_MM2:
                flags.append(frozenset(alone | {Flag.BLANK}))
                continue
            fit = _Fit(self, image, start[k], self._free(place_mm is not None))
            values[k], sigma[k], rms[k], raised = fit.run()
            flags.append(frozenset(alone | raised))
        return Recovered(values, sigma, rms, tuple(flags))

    def predict(self, values: Floats, px_mm: float) -> Images:
        """Images (B, N, N) of (B, 5) parameters."""
        outlines = self.model.profile(values[:, 0], values[:, 1])
        return coverage(outlines, origins(values), values[:, 4], size_px=self.size_px, px_mm=px_mm)

    def _free(self, anchored: bool) -> list[int]:
        """Numbers of the parameters that are fitted."""
        if not anchored:
            return [0, 1, 2, 3, 4]
        return [0, 1, 2, 3] if self.anchor_sigma_mm > 0 else [0, 1]

    def _nearest(self, seen: Moments, place_mm: Floats | None, heading_deg: Floats) -> Floats:
        """Starting points (H, alpha, x, y) of B fits, (B, 4): the press of the table that looks most alike."""
        features = [np.sqrt(seen.area), *seen.spread(heading_deg)]
        known = [np.sqrt(self.drawn.area), *self.drawn.spread(np.zeros(len(self.table)))]
        ahead, way = self.drawn.centroid[:, 0] - self.side_mm, directions(heading_deg)
        if place_mm is not None:
            features.append(np.sum(way * (seen.centroid - place_mm), axis=1))
            known.append(ahead)
        distance = np.square(np.stack(features, -1)[:, None] - np.stack(known, -1)[None]).sum(-1)
        best = np.argmin(distance, axis=1)
        # Between two depths of the table, interpolate by area, which grows as H^2.
        depth = self.table[best, 0] * np.sqrt(seen.area / np.maximum(self.drawn.area[best], 1e-12))
        place = place_mm
        if place is None:
            place = seen.centroid - (ahead[best] * depth / self.table[best, 0])[:, None] * way
        return np.column_stack((depth, self.table[best, 1], place))


def origins(values: Floats) -> Floats:
    """Where the brush axis meets the paper, (B, 2) mm from the left and top edge, for (B, 5) parameters."""
    ahead = values[:, 0] * np.tan(np.radians(values[:, 1]))
    return values[:, 2:4] + ahead[:, None] * directions(values[:, 4])


class _Fit:
    """The fit to one image, in the `free` parameters."""

    def __init__(self, inverter: Inverter, image: Images, start: Floats, free: list[int]) -> None:
        self._inverter, self._image, self._start, self._free = inverter, image, start, free
        side = inverter.side_mm
        # The place may lie beyond the image on every side.
        limits = (*(inverter.within.depth_mm, inverter.within.tilt_deg), (-side, 2 * side), (-side, 2 * side))
        self._low, self._high = np.array([*limits, (-720.0, 720.0)])[free].T
        sigma = np.array([0.0, 0.0, inverter.anchor_sigma_mm, inverter.anchor_sigma_mm, 0.0])[free]
        self._precision = np.where((sigma > 0) & (len(free) < 5), 1 / np.maximum(sigma, 1e-9) ** 2, 0.0)
        self._degrees = max(image.size - len(free), 1)

    def run(self) -> tuple[Floats, Floats, float, set[Flag]]:
        """Values (5,), standard deviations (5,), root mean square residual, and flags."""
        step = _STEP[self._free]
        lowest = descend(
            self._equations,
            self._clipped(self._start[self._free]),
            rounds=_ROUNDS,
            most=1.0,
            scale=step,
            gain=1e-9,
            feasible=self._clipped,
        )
        values, sigma = self._start.copy(), np.zeros(5)
        values[self._free] = lowest.vector
        residual, jacobian = self._linear(lowest.vector)
        sigma[self._free] = np.sqrt(self._variances(residual, jacobian))
        at_limit = (lowest.vector <= self._low) | (lowest.vector >= self._high)
        upright = at_limit[1] and values[1] == 0.0
        flags = {Flag.UPRIGHT} if upright else set[Flag]()
        if (at_limit & ~((np.array(self._free) == 1) & upright)).any():
            flags.add(Flag.AT_BOUND)
        left = np.linalg.lstsq(lowest.at.square, -lowest.at.gradient)[0]
        if (np.abs(step * left) > np.maximum(_STILL, _NEAR * sigma)[self._free]).any():
            flags.add(Flag.DID_NOT_CONVERGE)
        return values, sigma, math.sqrt(float(np.mean(np.square(residual)))), flags

    def _equations(self, vector: Floats) -> Equations:
        """-log likelihood at some values, and its derivatives in steps of `_STEP`."""
        residual, jacobian = self._linear(vector)
        noise = self._noise(residual)
        off, scale = vector - self._start[self._free], _STEP[self._free]
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
        count, nudges = len(vector), np.diag(_NUDGE[self._free])
        values = np.repeat(self._start[None], 2 * count + 1, axis=0)
        values[:, self._free] = self._clipped(vector + np.vstack((np.zeros(count), nudges, -nudges)))
        drawn = self._inverter.predict(values, self._inverter.px_mm)
        ahead, behind = slice(1, count + 1), slice(count + 1, None)
        widths = np.diag(values[ahead, self._free] - values[behind, self._free]).astype(np.float32)
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
        sandwich = bread @ (few * sums @ sums.T + noise**2 * np.diag(self._precision)) @ bread
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
