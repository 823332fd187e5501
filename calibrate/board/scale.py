"""Scale and plane from a ChArUco board in view: image pixels to millimetres on the paper, with an interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibrate.board.lens import Lens
from calibrate.errors import CalibrationError

Floats = NDArray[np.float64]
MIN_CORNERS = 8
BOOTSTRAP_DRAWS = 200
OUTLIER_PX = 1.0
OUTLIER_MEDIANS = 6.0
MOST_OUTLIERS = 0.1
WORST_RMS_PX = 1.0
"""Above this the board was not flat, not seen sharply, or is not the board of the configuration."""
BENT_SHARE = 0.85
"""Of the squared residuals. One radial term explains 0.7 of a board that is curled along its length, more of a lens."""
BENT = (
    "the lens bends straight lines: calibrate it with `brushloop camera intrinsics`, then name the lens file as "
    "camera.lens_file in rig.toml, or with --lens"
)
OTHER_LENS = "the lens still bends once it was straightened: the lens file is of another camera, or of another focus"


class BoardSpec(BaseModel):
    """A ChArUco board in the plane of the paper, in view of the camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    squares: tuple[Annotated[int, Field(ge=2, le=50)], Annotated[int, Field(ge=2, le=50)]]
    """Columns and rows of squares."""
    square_mm: Annotated[float, Field(gt=0.0, le=1000.0)]
    marker_mm: Annotated[float, Field(gt=0.0, le=1000.0)]
    dictionary: Annotated[str, Field(pattern=r"^DICT_[0-9A-Z_]+$")] = "DICT_5X5_1000"
    origin_mm: tuple[Annotated[float, Field(allow_inf_nan=False)], Annotated[float, Field(allow_inf_nan=False)]]
    """Lower left corner of the board, in the paper frame."""

    @model_validator(mode="after")
    def _exists(self) -> BoardSpec:
        if not isinstance(getattr(cv2.aruco, self.dictionary, None), int):
            raise ValueError(f"dictionary = {self.dictionary!r} is not one of OpenCV's DICT_*")
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm = {self.marker_mm} must be less than square_mm = {self.square_mm}")
        return self


@dataclass(frozen=True, slots=True)
class PlaneFit:
    """The paper plane as the camera sees it."""

    image_to_paper: Floats
    """(3, 3) homography: pixels (centres on integers) to mm in the paper frame."""
    mm_per_px: float
    """pix2len at the middle of the board."""
    interval_mm_per_px: tuple[float, float]
    """95 %, by bootstrap over corners: it holds the noise of corners, not an error of the printed board."""
    rms_px: float
    corners: int
    dropped: int
    """Corners left out because they do not lie on the plane of the others, as under the edge of a sheet."""


def find_corners(image: NDArray[np.uint8], spec: BoardSpec, where: str) -> tuple[Floats, Floats]:
    """((n, 2) pixels, (n, 2) mm in the paper frame) of the board's inner corners. Raises `CalibrationError`."""
    board = charuco_board(spec, where)
    # Sub-pixel corners matter: the scale's error is the corner error over the board's length.
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(board)
    detector.setDetectorParameters(parameters)
    pixels, ids, _, _ = detector.detectBoard(image)
    found = 0 if ids is None else len(ids)  # pyright: ignore[reportUnnecessaryComparison]
    if found < MIN_CORNERS:
        total = (spec.squares[0] - 1) * (spec.squares[1] - 1)
        _, mirrored, _, _ = detector.detectBoard(np.ascontiguousarray(image[:, ::-1]))
        if mirrored is not None and len(mirrored) >= MIN_CORNERS:  # pyright: ignore[reportUnnecessaryComparison]
            raise CalibrationError(where, "the photograph is mirrored: the board can only be read the other way round")
        raise CalibrationError(where, f"{found} of {total} board corners found, at least {MIN_CORNERS} are needed")
    on_board = np.asarray(board.getChessboardCorners(), np.float64)[np.ravel(ids).astype(np.int64), :2]
    height_mm = spec.squares[1] * spec.square_mm
    # The board counts y downward from its upper left corner; the paper frame counts it upward.
    paper = np.column_stack([spec.origin_mm[0] + on_board[:, 0], spec.origin_mm[1] + height_mm - on_board[:, 1]])
    return np.asarray(pixels, np.float64).reshape(-1, 2), paper


def fit_plane(pixels: Floats, paper_mm: Floats, where: str, seed: int = 0) -> PlaneFit:
    """Homography by least squares over all corners but outliers; scale at their middle, bootstrapped.

    Raises `CalibrationError` where more than a tenth are outliers or the residual is above `WORST_RMS_PX`: a wrong or
    bent board.
    """
    kept = _inliers(pixels, paper_mm, where)
    dropped = len(pixels) - int(kept.sum())
    if dropped > MOST_OUTLIERS * len(pixels):
        raise CalibrationError(where, f"{dropped} of {len(pixels)} board corners do not lie on one plane")
    pixels, paper_mm = pixels[kept], paper_mm[kept]
    image_to_paper = homography(pixels, paper_mm, where)
    rms_px = float(np.sqrt((_residuals_px(image_to_paper, pixels, paper_mm) ** 2).mean()))
    if rms_px > WORST_RMS_PX:
        raise CalibrationError(where, f"board residual {rms_px:.2f} px exceeds {WORST_RMS_PX} px: is it this board?")
    middle = pixels.mean(axis=0)
    rng = np.random.default_rng(seed)
    draws: list[float] = []
    for _ in range(BOOTSTRAP_DRAWS):
        chosen = rng.integers(0, len(pixels), len(pixels))
        if len(np.unique(chosen)) >= MIN_CORNERS // 2 + 1:
            draws.append(local_scale(homography(pixels[chosen], paper_mm[chosen], where), middle))
    low, high = (float(v) for v in np.quantile(draws, [0.025, 0.975]))
    return PlaneFit(image_to_paper, local_scale(image_to_paper, middle), (low, high), rms_px, len(pixels), dropped)


def see_board(image: NDArray[np.uint8], spec: BoardSpec, where: str = "camera", lens: Lens | None = None) -> PlaneFit:
    """Find the board and fit its plane. Raises `CalibrationError`; where the lens bends, it says how to undo that.

    With a lens the corners are straightened first: the plane's pixels are then those of `lens.straighten(image)`.
    """
    if lens is not None:
        lens.check_size(image, where)
    pixels, paper_mm = find_corners(image, spec, where)
    if lens is not None:
        pixels = lens.straight(pixels)
    try:
        return fit_plane(pixels, paper_mm, where)
    except CalibrationError as error:
        middle = np.array([image.shape[1] - 1, image.shape[0] - 1]) / 2.0
        if bent_share(pixels, paper_mm, middle, where) > BENT_SHARE:
            raise CalibrationError(where, f"{error.what}; {BENT if lens is None else OTHER_LENS}") from None
        raise


def bent_share(pixels: Floats, paper_mm: Floats, middle_px: Floats, where: str) -> float:
    """Share of a flat board's squared residuals that a radial distortion about the middle of the image explains.

    Linear: the displacement field of k1 (r^2 times the place, Brown's model), less what a homography takes up.
    """
    to_image = homography(paper_mm, pixels, where)
    left = (apply(to_image, paper_mm) - pixels).ravel()
    away = pixels - middle_px
    basis, _ = np.linalg.qr(_homography_slopes(to_image, paper_mm))
    field: Floats = ((away**2).sum(axis=1, keepdims=True) * away).ravel()
    field = field - basis @ (basis.T @ field)
    left = left - basis @ (basis.T @ left)
    total = float((left @ left) * (field @ field))
    return float(field @ left) ** 2 / total if total > 0.0 else 0.0


def _homography_slopes(to_image: Floats, paper_mm: Floats) -> Floats:
    """(2n, 8): how far each pixel moves with each of the first eight numbers of a homography whose ninth is fixed."""
    ones = np.column_stack([paper_mm, np.ones(len(paper_mm))])
    u, v, w = (ones @ to_image.T).T
    none = np.zeros_like(ones)
    across = np.column_stack([ones / w[:, None], none, -paper_mm * (u / w**2)[:, None]])
    along = np.column_stack([none, ones / w[:, None], -paper_mm * (v / w**2)[:, None]])
    return np.stack([across, along], axis=1).reshape(-1, 8)


def local_scale(image_to_paper: Floats, pixel: Floats) -> float:
    """mm per pixel at a pixel: square root of the area of its image on the paper."""
    step = 0.5
    corners = pixel + step * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    left, right, up, down = apply(image_to_paper, corners)
    across, along = right - left, down - up
    return float(np.sqrt(abs(across[0] * along[1] - across[1] * along[0])))


def apply(homography: Floats, points: Floats) -> Floats:
    """(n, 2) points through a (3, 3) homography."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def _inliers(pixels: Floats, paper_mm: Floats, where: str) -> NDArray[np.bool_]:
    # The median of squares ignores up to half of the corners; ChArUco rarely misnames more than one.
    robust, _ = cv2.findHomography(pixels, paper_mm, cv2.LMEDS)
    if robust is None or not np.all(np.isfinite(robust)):  # pyright: ignore[reportUnnecessaryComparison]
        raise CalibrationError(where, "the board's corners lie on a line: no plane can be had from them")
    residuals = _residuals_px(np.asarray(robust, np.float64), pixels, paper_mm)
    return residuals <= max(OUTLIER_PX, OUTLIER_MEDIANS * float(np.median(residuals)))


def _residuals_px(image_to_paper: Floats, pixels: Floats, paper_mm: Floats) -> Floats:
    back = apply(np.asarray(np.linalg.inv(image_to_paper), np.float64), paper_mm)
    return np.linalg.norm(back - pixels, axis=1)


def homography(pixels: Floats, paper_mm: Floats, where: str) -> Floats:
    """(3, 3) from (n, 2) to (n, 2) points by least squares. Raises `CalibrationError` where they lie on a line."""
    found, _ = cv2.findHomography(pixels, paper_mm, 0)
    if found is None or not np.all(np.isfinite(found)):  # pyright: ignore[reportUnnecessaryComparison]
        raise CalibrationError(where, "the board's corners lie on a line: no plane can be had from them")
    return np.asarray(found, np.float64)


def charuco_board(spec: BoardSpec, where: str) -> cv2.aruco.CharucoBoard:
    """OpenCV's board. Raises `CalibrationError` where there is none like it: more markers than the dictionary has."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    try:
        return cv2.aruco.CharucoBoard(spec.squares, spec.square_mm, spec.marker_mm, dictionary)
    except cv2.error as error:
        raise CalibrationError(where, f"the board cannot be made: {error}") from None
