"""`Inverter` recovers depth H, tilt alpha and place from images of presses, each with its interval and flags."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from brushloop.model.inversion.forward import PARAMETERS, Forward, Images, Outlines
from brushloop.model.inversion.jets import Jets, analytic, of_model
from brushloop.model.inversion.levenberg import Limits, fit
from brushloop.model.inversion.noise import Noise, covariance
from brushloop.model.inversion.start import MIN_INK_MM2, Table, moments_of
from brushloop.model.protocol import Basis, StrokeModel
from brushloop.model.raster.frame import PX_MM, SIZE_PX

Floats = NDArray[np.float64]
EDGE_INK = 0.3
"""With more ink than this in a pixel on the image's edge, the mark may continue beyond it."""
_STEP: dict[str, float] = dict(zip(PARAMETERS, (2.0, 4.0, 2.0, 2.0, 10.0), strict=True))
_STILL: dict[str, float] = dict(zip(PARAMETERS, (1e-4, 1e-3, 1e-4, 1e-4, 1e-3), strict=True))
TABLE_DEPTHS, TABLE_TILTS = 32, 7


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


class Known(StrEnum):
    """What is known about the place of a press."""

    ANCHOR = "anchor"
    """The zero-touch point, where the tip first touches the paper, and the heading: alpha moves the mark off it."""
    ORIGIN = "origin"
    """Where the brush axis meets the paper, and the heading. Simulations only: a rig needs alpha to know it."""
    NOTHING = "nothing"
    """Nothing: place and heading are fitted too."""


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
    """B recovered presses. `values` (B, 5) are H, alpha, x, y, heading (`PARAMETERS`), mm and degrees.

    `sigma` are standard deviations, 0 for known values and NaN where the image does not determine the value;
    `covariance` (B, P, P) is that of the parameters in `fitted`. x and y are the position of the anchor or origin in
    the image.
    """

    values: Floats
    sigma: Floats
    covariance: Floats
    fitted: tuple[str, ...]
    rms: Floats
    """Root mean square of target - predicted, (B,)."""
    iterations: NDArray[np.int64]
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
class Inverter:
    """Recovers presses from images, for one model, raster and `Known`. Make it once and use it for many batches.

    An `anchor_sigma_mm` above 0 is the anchor's standard deviation along either axis; its place is then fitted with
    that prior. `tilt_deg`, if given, fixes alpha, which is recommended without an anchor.
    """

    jets: Jets
    within: Range = field(default_factory=Range)
    known: Known = Known.ANCHOR
    noise: Noise = Noise.PIXEL
    size_px: int = SIZE_PX
    px_mm: float = PX_MM
    anchor_sigma_mm: float = 0.0
    tilt_deg: float | None = None
    table: Table = field(init=False)

    def __post_init__(self) -> None:
        if not (0 <= self.anchor_sigma_mm < math.inf):
            raise ValueError(f"anchor_sigma_mm = {self.anchor_sigma_mm:g}: expected at least 0")
        low, high = self.within.tilt_deg
        if self.tilt_deg is not None and not low <= self.tilt_deg <= high:
            raise ValueError(f"tilt_deg = {self.tilt_deg:g}: expected {low:g} to {high:g}")
        side = self.size_px * self.px_mm
        # Twice the image size at half the resolution, so that no mark is cut, wherever its origin lies.
        place = (side, side)
        held = np.array([[0.0, 0.0, *place, 0.0]])
        coarse = Outlines(self.jets, PARAMETERS[:2], held, self.known is Known.ANCHOR, self.size_px, 2 * self.px_mm)
        heights = np.geomspace(*self.within.depth_mm, TABLE_DEPTHS)
        tilts = np.array([self.tilt_deg]) if self.tilt_deg is not None else np.linspace(low, high, TABLE_TILTS)
        object.__setattr__(self, "table", Table.of(coarse, heights, tilts, place, 2 * self.px_mm))

    @classmethod
    def of_brush(cls, basis: Basis, **options: object) -> Inverter:
        """Make an inverter for CCD-BSM of a brush, with derivatives in closed form."""
        radius, length = float(basis.brush.radius_mm), float(basis.brush.length_mm)
        return cls(analytic(radius, length, basis.lam), **options)  # pyright: ignore[reportArgumentType]

    @classmethod
    def of_model(cls, model: StrokeModel, **options: object) -> Inverter:
        """Make an inverter for any stroke model, with derivatives by forward-mode differentiation."""
        return cls(of_model(model), **options)  # pyright: ignore[reportArgumentType]

    def __call__(
        self,
        images: NDArray[np.floating],  # pyright: ignore[reportMissingTypeArgument]
        place_mm: Floats | tuple[float, float] | None = None,
        heading_deg: Floats | float | None = None,
    ) -> Recovered:
        """Recover the presses of (B, N, N) coverage images, ink = 1.

        `place_mm` (2,) or (B, 2) is the known anchor or origin, mm from the left and top edge; `heading_deg` is the
        known heading, 0 by default. Raises ValueError for images of another size or values outside [0, 1].
        """
        target = self._checked(images)
        count = len(target)
        seen = moments_of(target, self.px_mm)
        free_place = self.known is Known.NOTHING
        if free_place is not (place_mm is None):
            raise ValueError(f"place_mm: expected {'none' if free_place else 'one'} where {self.known} is known")
        place = None if place_mm is None else np.broadcast_to(np.asarray(place_mm, np.float64), (count, 2))
        known = np.asarray(0.0 if heading_deg is None else heading_deg, np.float64)
        heading = seen.heading_deg() if free_place else np.broadcast_to(known, (count,))
        start = np.column_stack((self.table.nearest(seen, place, heading), heading))
        names = self._names()
        forward = Outlines(self.jets, names, start, self.known is Known.ANCHOR, self.size_px, self.px_mm)
        return recover(forward, target, start, self._limits(names), self.noise, seen.area < MIN_INK_MM2,
                        alpha_known=self.known is Known.ANCHOR, near_mm=self.px_mm)  # fmt: skip

    def assuming(self, tilt_deg: float) -> Inverter:
        """Return this inverter with alpha fixed at `tilt_deg`."""
        return replace(self, tilt_deg=tilt_deg)

    def _checked(self, images: NDArray[np.floating]) -> Images:  # pyright: ignore[reportMissingTypeArgument]
        target = np.ascontiguousarray(images, np.float32)
        wanted = (self.size_px, self.size_px)
        if target.ndim != 3 or target.shape[1:] != wanted:
            raise ValueError(f"images are {target.shape}, expected (B, {self.size_px}, {self.size_px})")
        return target

    def _names(self) -> tuple[str, ...]:
        names = ["depth_mm"] if self.tilt_deg is not None else ["depth_mm", "tilt_deg"]
        if self.known is Known.NOTHING:
            names += PARAMETERS[2:]
        elif self.anchor_sigma_mm > 0:
            names += PARAMETERS[2:4]
        return tuple(names)

    def _limits(self, names: tuple[str, ...]) -> Limits:
        # Beyond the image on every side, as an anchor may lie outside it.
        reach = (-self.size_px * self.px_mm, 2 * self.size_px * self.px_mm)
        box = {"depth_mm": self.within.depth_mm, "tilt_deg": self.within.tilt_deg}
        box |= {"x_mm": reach, "y_mm": reach, "heading_deg": (-720.0, 720.0)}
        precision: dict[str, float] = {}
        if self.known is Known.ANCHOR and self.anchor_sigma_mm > 0:
            precision = dict.fromkeys(("x_mm", "y_mm"), self.anchor_sigma_mm ** (-2))
        return limits_of(names, box, precision)


def limits_of(
    names: tuple[str, ...], box: dict[str, tuple[float, float]], precision: dict[str, float] | None = None
) -> Limits:
    """The limits of a fit in these parameters, with the steps of this module."""
    known = precision or {}
    columns = [(*box[n], _STEP.get(n, 1.0), _STILL.get(n, 1e-5), known.get(n, 0.0)) for n in names]
    return Limits(*np.array(columns, np.float64).T)


def recover(
    forward: Forward, target: Images, start: Floats, limits: Limits, noise: Noise, blank: NDArray[np.bool_],
    *, alpha_known: bool, near_mm: float,
) -> Recovered:  # fmt: skip
    """Fit B images from `start` (B, 5); `blank` (B,) holds no mark. `near_mm` is how far noise may move a mark."""
    columns = [PARAMETERS.index(name) for name in forward.names]
    found = fit(forward, target, start[:, columns], limits)
    near = np.array([1.5 * near_mm, 1.5, near_mm, near_mm, 1.0])[columns]
    spread = covariance(noise, forward, found, limits, near)
    values, sigma = start.copy(), np.zeros(start.shape)
    values[:, columns] = found.values
    sigma[:, columns] = np.sqrt(np.einsum("bii->bi", spread))
    values[blank] = sigma[blank] = np.nan
    at_limit = (found.values <= limits.low) | (found.values >= limits.high)
    upright = at_limit & (np.array(forward.names) == "tilt_deg") & (found.values == 0.0)
    held = "tilt_deg" not in forward.names
    raised = {
        Flag.ALPHA_UNKNOWN: np.full(len(target), held or not alpha_known),
        Flag.AT_BOUND: (at_limit & ~upright).any(axis=1) & ~blank,
        Flag.UPRIGHT: upright.any(axis=1) & ~blank,
        Flag.DID_NOT_CONVERGE: ~found.converged & ~blank,
        Flag.CUT: found.normal.cut > EDGE_INK,
        Flag.BLANK: blank,
    }
    flags = tuple(frozenset(flag for flag, of in raised.items() if of[n]) for n in range(len(target)))
    return Recovered(
        values, sigma, spread, forward.names, np.sqrt(found.normal.cost / found.pixels), found.iterations, flags
    )
