"""The paper plane through a lens that bends: homography and radial terms fitted together, pix2len with its interval."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import stdtrit

from calibrate.board.lens import Floats, Lens
from calibrate.board.scale import MOST_OUTLIERS, WORST_RMS_PX, apply, homography
from calibrate.errors import CalibrationError

RADIAL_TERMS = 1
"""k1 is fitted anew on every view: refocusing changes it. A second term costs a flat view three times the interval."""
OUTLIER_SIGMAS = 5.0
LEAST_OUTLIER_PX = 0.75
SOFT_PX = 0.5
"""Residuals far above this count less while outliers are still in."""
STEP_PX = 0.5
LAGS = 2
"""Squares over which the errors of corners may be correlated."""


@dataclass(frozen=True, slots=True)
class Plane:
    """The paper plane as a camera sees it, and the lens that it was seen through."""

    lens: Lens
    """With the radial terms of this view."""
    image_to_paper: Floats
    """(3, 3) homography: pixels of the straightened photograph (centres on integers) to mm in the paper frame."""
    mm_per_px: float
    """pix2len in the middle of the corners, of the photograph as it was taken."""
    interval_mm_per_px: tuple[float, float]
    """95 %: the noise of corners carried through homography and radial terms, not an error of the printed board."""
    rms_px: float
    bend_px: float
    """How much the lens as it was given leaves bent: root mean square of what the radial terms of this view explain."""
    middle_px: tuple[float, float]
    """Where pix2len holds, in the photograph as it was taken."""
    corners: int
    dropped: tuple[int, ...]
    """Corners, by their place among those given, that do not lie on the plane of the others."""

    def scale_at(self, pixel: Floats) -> float:
        """mm per pixel of the photograph as it was taken, at one of its pixels (2,)."""
        around = pixel + STEP_PX * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
        left, right, up, down = self.to_paper(around)
        across, along = right - left, down - up
        return float(np.sqrt(abs(across[0] * along[1] - across[1] * along[0]))) / (2.0 * STEP_PX)

    def to_paper(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of the photograph as it was taken -> mm in the paper frame."""
        return apply(self.image_to_paper, self.lens.straight(pixels))

    def to_image(self, paper_mm: Floats) -> Floats:
        """(n, 2) mm in the paper frame -> pixels of the photograph as it was taken."""
        return self.lens.bent(apply(np.asarray(np.linalg.inv(self.image_to_paper), np.float64), paper_mm))


def fit_bent_plane(pixels: Floats, paper_mm: Floats, lens: Lens, where: str, radial_terms: int = RADIAL_TERMS) -> Plane:
    """Least squares on reprojection in the photograph as it was taken, over (n, 2) corners but outliers.

    Minimises |bent(H mm) - px| over the eight numbers of H and the first `radial_terms` of k1, k2. pix2len is a
    function of the same numbers, so its standard error follows by the delta method (Hartley and Zisserman, Multiple
    View Geometry, 2nd ed., section 5.2), with corners that err alike counted as such. Raises `CalibrationError` as
    `fit_plane` does.
    """
    model = _Model(lens, paper_mm.mean(axis=0), float(np.ptp(paper_mm, axis=0).max()), radial_terms)
    start = model.start(pixels, paper_mm, where)

    def residuals(theta: Floats, kept: NDArray[np.bool_]) -> Floats:
        return (model.project(theta, paper_mm[kept]) - pixels[kept]).ravel()

    everything = np.ones(len(pixels), np.bool_)
    soft = least_squares(residuals, start, args=(everything,), loss="cauchy", f_scale=SOFT_PX, x_scale="jac")
    away = np.linalg.norm(residuals(soft.x, everything).reshape(-1, 2), axis=1)
    kept = away <= max(LEAST_OUTLIER_PX, OUTLIER_SIGMAS * float(np.median(away)))
    dropped = np.flatnonzero(~kept)
    if len(dropped) > MOST_OUTLIERS * len(pixels):
        raise CalibrationError(where, f"{len(dropped)} of {len(pixels)} board corners do not lie on one plane")
    fitted = least_squares(residuals, soft.x, args=(kept,), x_scale="jac", method="lm")
    left = residuals(fitted.x, kept)
    rms_px = float(np.sqrt(2.0 * np.mean(left**2)))
    if rms_px > WORST_RMS_PX:
        raise CalibrationError(where, f"board residual {rms_px:.2f} px exceeds {WORST_RMS_PX} px: is it this board?")
    free = left.size - fitted.x.size
    middle = pixels[kept].mean(axis=0)
    scale = model.log_scale(fitted.x, middle)
    jacobian = np.asarray(fitted.jac, np.float64)
    # How far each corner's error moves the scale, (n, 2).
    pull = (jacobian @ np.linalg.pinv(jacobian.T @ jacobian) @ model.slope(fitted.x, middle)).reshape(-1, 2)
    spread = _spread(pull, left.reshape(-1, 2), paper_mm[kept], float(left @ left) / free)
    reach = float(stdtrit(free, 0.975)) * spread
    refined, image_to_paper = model.parts(fitted.x)
    straight = lens.straight(pixels[kept])
    flat = apply(homography(paper_mm[kept], straight, where), paper_mm[kept]) - straight
    flat_rms_px = float(np.sqrt((flat**2).sum(axis=1).mean()))
    return Plane(
        refined,
        image_to_paper,
        float(np.exp(scale)),
        (float(np.exp(scale - reach)), float(np.exp(scale + reach))),
        rms_px,
        float(np.sqrt(max(flat_rms_px**2 - rms_px**2, 0.0))),
        (float(middle[0]), float(middle[1])),
        int(kept.sum()),
        tuple(int(k) for k in dropped),
    )


def _spread(pull: Floats, left: Floats, paper_mm: Floats, variance: float) -> float:
    """Standard error of what corners pull at by `pull`, their errors correlated as their residuals are.

    Where edges fall alike on the pixels, neighbours err alike: the correlation is read from pairs one and two squares
    apart and tapered as by Newey and West (Econometrica 55, 1987). It may only widen the interval.
    """
    apart = np.linalg.norm(paper_mm[:, None] - paper_mm[None], axis=2)
    squares = np.rint(apart / np.min(apart[apart > 0.0])).astype(np.int64)
    alike, together = left @ left.T / 2.0, np.eye(len(left))
    for lag in range(1, LAGS + 1):
        pairs = squares == lag
        if pairs.any():
            together[pairs] = float(alike[pairs].mean()) / variance * (1.0 - lag / (LAGS + 1.0))
    correlated = float(np.einsum("ik,ij,jk->", pull, together, pull))
    return float(np.sqrt(variance * max(correlated, float((pull**2).sum()))))


def _steps(theta: Floats) -> list[Floats]:
    return list(np.diag(1e-5 * np.maximum(np.abs(theta), 1e-2)))


@dataclass(frozen=True, slots=True)
class _Model:
    """Plane to photograph with parameters of one size: paper in board lengths, pixels in focal lengths."""

    lens: Lens
    middle_mm: Floats
    length_mm: float
    radial_terms: int

    def start(self, pixels: Floats, paper_mm: Floats, where: str) -> Floats:
        straight = self.lens.straight(pixels)
        paper_to_rays = self._rays() @ homography(paper_mm, straight, where) @ self._from_unit()
        return np.concatenate(
            [(paper_to_rays / paper_to_rays[2, 2]).ravel()[:8], self.lens.distortion[: self.radial_terms]]
        )

    def project(self, theta: Floats, paper_mm: Floats) -> Floats:
        lens, paper_to_rays = self._lens(theta), self._matrix(theta)
        unit = (paper_mm - self.middle_mm) / self.length_mm
        return lens.bent(apply(np.linalg.inv(self._rays()) @ paper_to_rays, unit))

    def log_scale(self, theta: Floats, pixel: Floats) -> float:
        """Logarithm of mm per px of the photograph as it was taken, at a pixel."""
        lens, image_to_paper = self.parts(theta)
        around = pixel + STEP_PX * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
        left, right, up, down = apply(image_to_paper, lens.straight(around))
        across, along = right - left, down - up
        area = abs(float(across[0] * along[1] - across[1] * along[0])) / (2.0 * STEP_PX) ** 2
        return 0.5 * float(np.log(area))

    def slope(self, theta: Floats, pixel: Floats) -> Floats:
        """Derivative of `log_scale` by each parameter, by central differences."""
        steps = _steps(theta)
        change = [self.log_scale(theta + d, pixel) - self.log_scale(theta - d, pixel) for d in steps]
        return np.array(change) / (2.0 * np.diag(np.array(steps)))

    def parts(self, theta: Floats) -> tuple[Lens, Floats]:
        """The lens, and straightened pixels to mm."""
        paper_to_image = np.linalg.inv(self._rays()) @ self._matrix(theta) @ np.linalg.inv(self._from_unit())
        image_to_paper = np.linalg.inv(paper_to_image)
        return self._lens(theta), np.asarray(image_to_paper / image_to_paper[2, 2], np.float64)

    def _lens(self, theta: Floats) -> Lens:
        distortion = self.lens.distortion.copy()
        distortion[: self.radial_terms] = theta[8:]
        return replace(self.lens, distortion=distortion)

    def _matrix(self, theta: Floats) -> Floats:
        return np.append(theta[:8], 1.0).reshape(3, 3)

    def _rays(self) -> Floats:
        return np.asarray(np.linalg.inv(self.lens.matrix), np.float64)

    def _from_unit(self) -> Floats:
        s, (x, y) = self.length_mm, self.middle_mm
        return np.array([[s, 0.0, x], [0.0, s, y], [0.0, 0.0, 1.0]])
