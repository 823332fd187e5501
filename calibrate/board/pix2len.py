"""The paper plane in a photograph: homography and radial lens terms fitted together, pix2len with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np
from pydantic import Field

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import Floats, Gray, Lens, apply, homography, unknown_lens
from brushloop.calibrate.board.spec import BoardSpec, BoardView
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
VISIBLE_PX = 0.5
"""A lens that distorts the board by more (root mean square) needs a lens file: one flat view cannot calibrate it."""
REMAINING_PX = 1.5
"""Distortion left by the lens file: more means another camera; less is a small change of focus, which k1 describes."""
NO_LENS_FILE = (
    "the lens bends straight lines: calibrate the lens with `brushloop camera intrinsics`, then name its file as "
    "camera.lens_file in rig.toml, or with --lens"
)
OTHER_LENS = "distortion remains after the lens was corrected: the lens file is of another camera, or of another focus"
SAMPLES = 21
"""Rows and columns of pixels around a corner by which two photographs are compared."""
LEAST_LIKENESS = 0.99
"""Least correlation around a corner of a board that has not moved: noise leaves 0.998, half a pixel 0.985 to 0.99."""
Matrix: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""A homography, row by row."""


def local_scale(to_paper: Callable[[Floats], Floats], pixel: Floats) -> float:
    """mm per pixel at a pixel (2,): the square root of the area that the pixel covers on the paper."""
    around = pixel + STEP_PX * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    left, right, up, down = to_paper(around)
    across, along = right - left, down - up
    return math.sqrt(abs(float(across[0] * along[1] - across[1] * along[0]))) / (2.0 * STEP_PX)


class Plane(Frozen):
    """The paper plane as a camera sees it, and the lens that it was seen through."""

    image_to_paper: Matrix
    """Homography: pixels (centres on integers) of the undistorted photograph to mm in the paper frame."""
    mm_per_px: float
    """pix2len in the middle of the corners that were seen, for the photograph as taken (with distortion)."""
    mm_per_px_low: float
    mm_per_px_high: float
    """95 % interval: propagates the noise of corners, but does not include errors of the printed board."""
    rms_px: float
    corners: int
    corners_dropped: int
    """Outliers: seen, but not on the plane of the others."""
    lens: Lens
    """Lens by which photographs are undistorted first, with the radial terms of this view."""
    middle_px: tuple[float, float]
    """Pixel at which `mm_per_px` holds, in the photograph as it was taken."""
    flags: tuple[str, ...] = ()
    """Problems with the photograph, although the board was found: partly hidden, saturated."""
    distortion_px: float = Field(default=0.0, exclude=True)
    """Distortion that the lens given to the fit does not describe: root mean square of the part that this view's terms
    explain. It is not written to files."""

    @property
    def relative_reach(self) -> float:
        """Half the width of pix2len's interval, as a share of pix2len."""
        return (self.mm_per_px_high - self.mm_per_px_low) / (2.0 * self.mm_per_px)

    @property
    def homography(self) -> Floats:
        """`image_to_paper` as (3, 3)."""
        return np.array(self.image_to_paper).reshape(3, 3)

    def to_paper(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of the photograph as it was taken -> mm in the paper frame."""
        return apply(self.homography, self.lens.undistorted(pixels))

    def to_image(self, paper_mm: Floats) -> Floats:
        """(n, 2) mm in the paper frame -> pixels of the photograph as it was taken."""
        return self.lens.distorted(apply(np.asarray(np.linalg.inv(self.homography), np.float64), paper_mm))


@dataclass(frozen=True, slots=True)
class SeenBoard:
    """The board in an undistorted photograph of a camera that stays where it is."""

    plane: Plane
    image: Gray
    corners_px: Floats
    """(n, 2) that were seen."""
    square_px: float
    """Side of a square."""

    def unmoved_in(self, image: Gray) -> bool:
        """Whether a later photograph shows the same around every corner, in whatever light.

        A board that moved by a pixel does not pass, nor one that is partly hidden, blurred, or another one.
        """
        if image.shape != self.image.shape:
            return False
        # Half a square to either side: by the markers, a board that moved by whole squares looks different too.
        reach_px = np.linspace(-0.5, 0.5, SAMPLES) * self.square_px
        places = self.corners_px[:, None] + np.stack(np.meshgrid(reach_px, reach_px), axis=-1).reshape(-1, 2)
        columns, rows = np.clip(np.rint(places), 0, np.array(image.shape[::-1]) - 1).astype(np.int64).transpose(2, 0, 1)
        before, now = (_normalised(each[rows, columns]) for each in (self.image, image))
        return float((before * now).sum(axis=1).min()) >= LEAST_LIKENESS


def _normalised(levels: Gray) -> Floats:
    """(n, k) gray levels with average 0 and length 1 in each row: light and contrast are taken off."""
    off = levels - levels.mean(axis=1, keepdims=True)
    return off / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1.0)


def see_board(image: Gray, spec: BoardSpec, known: SeenBoard | None = None) -> SeenBoard:
    """Find the board in an undistorted photograph, and fit the paper plane; `known` again if it has not moved since.

    Raises `CalibrationError`; if the lens distorts, the message says what to do about it.
    """
    if known is not None and known.unmoved_in(image):
        return known
    view = find_board(image, spec, "camera")
    corners, lens = (view.pixels, paper_mm(view, spec)), unknown_lens(view.size_px)
    try:
        plane = fit_plane(*corners, lens, view.name, radial_terms=0)
    except CalibrationError:
        _check_distortion(fit_plane(*corners, lens, view.name), None, view.name)
        raise
    return SeenBoard(plane, image, view.pixels, spec.square_mm / plane.mm_per_px)


def see_board_and_lens(
    image: Gray, spec: BoardSpec, lens: Lens | None, where: str, sheet_mm: tuple[float, float] | None = None
) -> tuple[BoardView, Plane]:
    """The corners in a photograph as it was taken; and the paper plane, fitted to them together with the lens's k1.

    A sheet of `sheet_mm` may lie on the board. Raises `CalibrationError`, also for a lens that distorts more than is
    known.
    """
    if lens is not None:
        lens.check_size(image, where)
    view = find_board(image, spec, where, None if sheet_mm is None else corners_beside(spec, sheet_mm))
    plane = fit_plane(view.pixels, paper_mm(view, spec), lens or unknown_lens(view.size_px), where)
    _check_distortion(plane, lens, where)
    return view, plane.model_copy(update={"flags": view.flags})


def _check_distortion(plane: Plane, lens: Lens | None, where: str) -> None:
    """Raise `CalibrationError` for a plane that was fitted with k1, if the known lens distorts more than allowed."""
    if plane.distortion_px > (VISIBLE_PX if lens is None else REMAINING_PX):
        advice = NO_LENS_FILE if lens is None else OTHER_LENS
        raise CalibrationError(where, f"the board looks bent by {plane.distortion_px:.1f} px: if it is flat, {advice}")


def paper_mm(view: BoardView, spec: BoardSpec) -> Floats:
    """(n, 2) corners of a view in the paper frame."""
    depth_mm = spec.squares[1] * spec.square_mm
    # The board counts y downward from its upper left corner; the paper frame counts it upward.
    flip = np.array([1.0, -1.0])
    return np.array([spec.origin_mm[0], spec.origin_mm[1] + depth_mm]) + flip * view.board_mm


def corners_beside(spec: BoardSpec, sheet_mm: tuple[float, float]) -> int:
    """Number of corners at least half a square outside a sheet that lies at the origin of the paper frame."""
    (columns, rows), side, (x_mm, y_mm) = spec.squares, spec.square_mm, spec.origin_mm
    # Counted from the middle of the sheet.
    across = np.abs(x_mm + side * np.arange(1, columns) - 0.5 * sheet_mm[0]) >= 0.5 * (sheet_mm[0] + side)
    along = np.abs(y_mm + side * np.arange(1, rows) - 0.5 * sheet_mm[1]) >= 0.5 * (sheet_mm[1] + side)
    return int((across[:, None] | along).sum())


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
    start, corners = model.start(pixels, paper_mm, where), (pixels, paper_mm)
    soft = least_squares(model.residuals, start, args=corners, loss="cauchy", f_scale=SOFT_PX, x_scale="jac")
    away = np.linalg.norm(model.residuals(soft.x, *corners).reshape(-1, 2), axis=1)
    kept = away <= max(LEAST_OUTLIER_PX, OUTLIER_SIGMAS * float(np.median(away)))
    dropped = int((~kept).sum())
    if dropped > MOST_OUTLIERS * len(pixels):
        raise CalibrationError(where, f"{dropped} of {len(pixels)} board corners do not lie on one plane")
    corners = pixels[kept], paper_mm[kept]
    fitted = least_squares(model.residuals, soft.x, args=corners, x_scale="jac", method="lm")
    left = model.residuals(fitted.x, *corners)
    rms_px = float(np.sqrt(2.0 * np.mean(left**2)))
    if rms_px > WORST_RMS_PX:
        raise CalibrationError(where, f"board residual {rms_px:.2f} px exceeds {WORST_RMS_PX} px: wrong or bent board?")
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
    flat_rms_px = float(np.sqrt(2.0 * np.mean(flat**2)))
    return Plane(
        image_to_paper=cast("Matrix", tuple(image_to_paper.ravel().tolist())),
        mm_per_px=float(np.exp(scale)),
        mm_per_px_low=float(np.exp(scale - reach)),
        mm_per_px_high=float(np.exp(scale + reach)),
        rms_px=rms_px,
        corners=int(kept.sum()),
        corners_dropped=dropped,
        lens=refined,
        middle_px=(float(middle[0]), float(middle[1])),
        distortion_px=float(np.sqrt(max(flat_rms_px**2 - rms_px**2, 0.0))),
    )


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


@dataclass(frozen=True, slots=True)
class _Model:
    """Plane to photograph with parameters of similar size: paper in board lengths, pixels in focal lengths."""

    lens: Lens
    from_unit: Floats
    """(3, 3): from board lengths, counted from the middle of the corners, to mm."""
    radial_terms: int

    @classmethod
    def of(cls, lens: Lens, paper_mm: Floats, radial_terms: int) -> _Model:
        """Make a model scaled to the board's corners."""
        (x, y), length = paper_mm.mean(axis=0), np.ptp(paper_mm, axis=0).max()
        return cls(lens, np.array([[length, 0.0, x], [0.0, length, y], [0.0, 0.0, 1.0]]), radial_terms)

    def start(self, pixels: Floats, paper_mm: Floats, where: str) -> Floats:
        paper_to_image = homography(paper_mm, self.lens.undistorted(pixels), where)
        unit_to_rays = np.linalg.inv(self.lens.camera) @ paper_to_image @ self.from_unit
        return np.append((unit_to_rays / unit_to_rays[2, 2]).ravel()[:8], self.lens.distortion[: self.radial_terms])

    def parts(self, theta: Floats) -> tuple[Lens, Floats]:
        """The lens, and the homography from undistorted pixels to mm."""
        distortion = (*theta[8:].tolist(), *self.lens.distortion[self.radial_terms :])
        unit_to_image = self.lens.camera @ np.append(theta[:8], 1.0).reshape(3, 3)
        image_to_paper = self.from_unit @ np.linalg.inv(unit_to_image)
        lens = self.lens.model_copy(update={"distortion": distortion})
        return lens, np.asarray(image_to_paper / image_to_paper[2, 2], np.float64)

    def residuals(self, theta: Floats, pixels: Floats, paper_mm: Floats) -> Floats:
        """(2 n,) px by which the (n, 2) corners of the plane miss those of the photograph as taken."""
        lens, image_to_paper = self.parts(theta)
        straight = apply(np.asarray(np.linalg.inv(image_to_paper), np.float64), paper_mm)
        return (lens.distorted(straight) - pixels).ravel()

    def log_scale(self, theta: Floats, pixel: Floats) -> float:
        """Logarithm of mm per px of the photograph as taken, at a pixel."""
        lens, image_to_paper = self.parts(theta)
        return math.log(local_scale(lambda at: apply(image_to_paper, lens.undistorted(at)), pixel))

    def slope(self, theta: Floats, pixel: Floats) -> Floats:
        """Derivative of `log_scale` with respect to each parameter, by central differences."""
        steps = np.diag(1e-5 * np.maximum(np.abs(theta), 1e-2))
        change = [self.log_scale(theta + step, pixel) - self.log_scale(theta - step, pixel) for step in steps]
        return np.array(change) / (2.0 * np.diag(steps))
