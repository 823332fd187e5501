"""The paper plane in a photograph: homography and radial lens terms fitted together, pix2len with its interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, Lens, rms
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stats import student_95

MOST_OUTLIERS = 0.1
WORST_RMS_PX = 1.0
"""Residual above which the board was not flat, was out of focus, or is not the configured board."""
RADIAL_TERMS = 1
"""k1 is refitted for every view, as refocusing changes it. With a flat view, a second term triples the interval."""
OUTLIER_SIGMAS = 5.0
LEAST_OUTLIER_PX = 0.75
SOFT_PX = 0.5
"""Residuals far above this are given less weight until outliers are removed."""
STEP_PX = 0.5
LAGS = 2
"""Distance in squares over which corner errors may be correlated."""


def apply(homography: Floats, points: Floats) -> Floats:
    """Map (n, 2) points through a (3, 3) homography."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def homography(pixels: Floats, paper_mm: Floats, where: str) -> Floats:
    """Fit the (3, 3) homography from (n, 2) to (n, 2) points. Raises `CalibrationError` if they lie on a line."""
    found, _ = cv2.findHomography(pixels, paper_mm, 0)
    if found is None or not np.all(np.isfinite(found)):  # pyright: ignore[reportUnnecessaryComparison]
        raise CalibrationError(where, "the board's corners lie on a line, which does not determine a plane")
    return np.asarray(found, np.float64)


def local_scale(to_paper: Callable[[Floats], Floats], pixel: Floats) -> float:
    """mm per pixel at a pixel (2,): the square root of the area that the pixel covers on the paper."""
    return float(np.sqrt(_area(to_paper, pixel))) / (2.0 * STEP_PX)


def _area(to_paper: Callable[[Floats], Floats], pixel: Floats) -> float:
    around = pixel + STEP_PX * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    left, right, up, down = to_paper(around)
    across, along = right - left, down - up
    return abs(float(across[0] * along[1] - across[1] * along[0]))


@dataclass(frozen=True, slots=True)
class Plane:
    """The paper plane as a camera sees it, and the lens that it was seen through."""

    lens: Lens
    """The lens, with the radial terms of this view."""
    image_to_paper: Floats
    """(3, 3) homography: pixels of the undistorted photograph (centres on integers) to mm in the paper frame."""
    mm_per_px: float
    """pix2len in the middle of the corners, for the photograph as taken (with distortion)."""
    interval_mm_per_px: tuple[float, float]
    """95 % interval: propagates the noise of corners, but does not include errors of the printed board."""
    rms_px: float
    distortion_px: float
    """Distortion that the given lens does not describe: root mean square of the part that this view's terms explain."""
    middle_px: tuple[float, float]
    """Pixel at which pix2len holds, in the photograph as taken."""
    corners: int
    dropped: tuple[int, ...]
    """Indices of corners that do not lie in the plane of the others."""
    flags: tuple[str, ...] = ()
    """Problems with the photograph, although the board was found: partly hidden, saturated."""

    def scale_at(self, pixel: Floats) -> float:
        """mm per pixel of the photograph as taken, at one of its pixels (2,)."""
        return local_scale(self.to_paper, pixel)

    def to_paper(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of the photograph as it was taken -> mm in the paper frame."""
        return apply(self.image_to_paper, self.lens.undistorted(pixels))

    def to_image(self, paper_mm: Floats) -> Floats:
        """(n, 2) mm in the paper frame -> pixels of the photograph as it was taken."""
        return self.lens.distorted(apply(np.asarray(np.linalg.inv(self.image_to_paper), np.float64), paper_mm))


def fit_plane(pixels: Floats, paper_mm: Floats, lens: Lens, where: str, radial_terms: int = RADIAL_TERMS) -> Plane:
    """Fit the plane to (n, 2) corners by least squares on reprojection in the photograph as it was taken.

    Minimises |distort(H mm) - px| over the eight numbers of H and the first `radial_terms` of k1, k2; with 0 the lens
    stays as given. pix2len is a function of the same numbers, so its standard error follows by the delta method
    (Hartley and Zisserman, Multiple View Geometry, 2nd ed., section 5.2), including the correlation of neighbouring
    corners. Raises `CalibrationError` where more than a tenth of the corners are outliers or the residual is above
    `WORST_RMS_PX`: a wrong or curled board.
    """
    from scipy.optimize import least_squares  # slow to import

    model = _Model.of(lens, paper_mm, radial_terms)
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
    # Change of the scale with each corner's error, (n, 2).
    pull = (jacobian @ np.linalg.pinv(jacobian.T @ jacobian) @ model.slope(fitted.x, middle)).reshape(-1, 2)
    spread = _spread(pull, left.reshape(-1, 2), paper_mm[kept], float(left @ left) / free)
    reach = student_95(free) * spread
    refined, image_to_paper = model.parts(fitted.x)
    undistorted = lens.undistorted(pixels[kept])
    flat = apply(homography(paper_mm[kept], undistorted, where), paper_mm[kept]) - undistorted
    flat_rms_px = rms(flat)
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


def distorted_share(pixels: Floats, paper_mm: Floats, lens: Lens, where: str) -> float:
    """Share of a flat board's squared residuals with this lens that refitting k1 would explain; outliers included."""

    from scipy.optimize import least_squares

    def cost(radial_terms: int) -> float:
        model = _Model.of(lens, paper_mm, radial_terms)

        def residuals(theta: Floats) -> Floats:
            return (model.project(theta, paper_mm) - pixels).ravel()

        return float(least_squares(residuals, model.start(pixels, paper_mm, where), x_scale="jac").cost)

    flat = cost(0)
    return 1.0 - cost(1) / flat if flat > 0.0 else 0.0


def _spread(pull: Floats, left: Floats, paper_mm: Floats, variance: float) -> float:
    """Standard error of a quantity that each corner error moves by `pull`; errors correlate as the residuals do.

    Neighbouring edges that cross the pixel rows in the same way have similar errors. Their correlation is estimated
    from pairs one and two squares apart, tapered as by Newey and West (Econometrica 55, 1987), and only ever widens
    the interval.
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
    """Plane to photograph with parameters of similar size: paper in board lengths, pixels in focal lengths."""

    lens: Lens
    middle_mm: Floats
    length_mm: float
    radial_terms: int

    @classmethod
    def of(cls, lens: Lens, paper_mm: Floats, radial_terms: int) -> _Model:
        """Make a model scaled to the board's corners."""
        return cls(lens, paper_mm.mean(axis=0), float(np.ptp(paper_mm, axis=0).max()), radial_terms)

    def start(self, pixels: Floats, paper_mm: Floats, where: str) -> Floats:
        undistorted = self.lens.undistorted(pixels)
        paper_to_rays = self._rays() @ homography(paper_mm, undistorted, where) @ self._from_unit()
        return np.concatenate(
            [(paper_to_rays / paper_to_rays[2, 2]).ravel()[:8], self.lens.distortion[: self.radial_terms]]
        )

    def project(self, theta: Floats, paper_mm: Floats) -> Floats:
        lens, paper_to_rays = self._lens(theta), self._matrix(theta)
        unit = (paper_mm - self.middle_mm) / self.length_mm
        return lens.distorted(apply(np.linalg.inv(self._rays()) @ paper_to_rays, unit))

    def log_scale(self, theta: Floats, pixel: Floats) -> float:
        """Logarithm of mm per px of the photograph as taken, at a pixel."""
        lens, image_to_paper = self.parts(theta)
        area = _area(lambda at: apply(image_to_paper, lens.undistorted(at)), pixel)
        return 0.5 * float(np.log(area / (2.0 * STEP_PX) ** 2))

    def slope(self, theta: Floats, pixel: Floats) -> Floats:
        """Derivative of `log_scale` with respect to each parameter, by central differences."""
        steps = _steps(theta)
        change = [self.log_scale(theta + d, pixel) - self.log_scale(theta - d, pixel) for d in steps]
        return np.array(change) / (2.0 * np.diag(np.array(steps)))

    def parts(self, theta: Floats) -> tuple[Lens, Floats]:
        """The lens, and the homography from undistorted pixels to mm."""
        paper_to_image = np.linalg.inv(self._rays()) @ self._matrix(theta) @ np.linalg.inv(self._from_unit())
        image_to_paper = np.linalg.inv(paper_to_image)
        return self._lens(theta), np.asarray(image_to_paper / image_to_paper[2, 2], np.float64)

    def _lens(self, theta: Floats) -> Lens:
        distortion = (*theta[8:].tolist(), *self.lens.distortion[self.radial_terms :])
        return self.lens.model_copy(update={"distortion": distortion})

    def _matrix(self, theta: Floats) -> Floats:
        return np.append(theta[:8], 1.0).reshape(3, 3)

    def _rays(self) -> Floats:
        return np.asarray(np.linalg.inv(self.lens.camera), np.float64)

    def _from_unit(self) -> Floats:
        s, (x, y) = self.length_mm, self.middle_mm
        return np.array([[s, 0.0, x], [0.0, s, y], [0.0, 0.0, 1.0]])
