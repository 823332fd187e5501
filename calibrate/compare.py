"""The 128 x 128 images that are compared: how strokes and marks are placed on them, and the score of two images.

Two alignment protocols: `mm` keeps millimetres and the zero-touch anchor; `size-normalised` scales each image to one
length and then takes the best shift. The second reproduces the spread in the paper; the first is the honest one. At
the end stand the scores that the paper prints.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.stroke.preprocess import Prepared
from brushloop.model.ccdbsm import Brush
from brushloop.model.outline import Outline
from brushloop.model.presses import Grid
from brushloop.model.raster import coverage
from brushloop.model.similarity import csim_and_ssim, inked_window
from brushloop.model.strokes import StrokeModel
from brushloop.sessions.records import Header

Image = NDArray[np.float32]
Pixels = NDArray[np.uint8]
"""Ink from 0 to 255."""
SIZE_PX = 128
MM_PER_PX = 0.3
"""Scale of the millimetre field, wherever a press is shown, fitted, compared or inverted.

38.4 mm hold an anchored stroke of any condition of the grid; 0.2 mm/px would not.
"""
FIELD_MM = SIZE_PX * MM_PER_PX
"""Width and height of the millimetre field around the zero-touch point."""
ANCHOR_MM = (0.76 * FIELD_MM, 0.5 * FIELD_MM)
"""Distance of the zero-touch point from the left and from the top of the field."""
NORMAL_LENGTH_PX = 100
FINE = 4
"""Oversampling: strokes are moved on a raster finer by this factor, near their own 20 px/mm, then area-averaged."""
BEST_SHIFT_PX = 6
"""Most that a size-normalised image is shifted each way."""
AT_ONCE = 4
"""Images that are compared at once; for the arrays of many, the system would give the memory anew each time."""
_REACH = range(-BEST_SHIFT_PX, BEST_SHIFT_PX + 1)
SHIFTS = np.array(sorted(itertools.product(_REACH, _REACH), key=lambda shift: shift[0] ** 2 + shift[1] ** 2))
"""(n, 2) rows and columns of every shift, the smallest first."""


class Alignment(StrEnum):
    """How captured and simulated images are aligned."""

    MM = "mm"
    SIZE_NORMALISED = "size-normalised"


class Tone(StrEnum):
    """Meaning of a pixel's value."""

    BINARY = "binary"
    GRAY = "gray"


class Polarity(StrEnum):
    """Whether ink or paper is 1."""

    INK = "ink = 1"
    PAPER = "paper = 1"


Key = tuple[Alignment, Tone]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone))
"""Every way in which two images are compared."""
STRICT: Key = (Alignment.MM, Tone.BINARY)
NORMAL: Key = (Alignment.SIZE_NORMALISED, Tone.BINARY)
"""The comparison where size and place count, and that of the paper."""
MM_BINARY, MM_GRAY = (KEYS.index((Alignment.MM, tone)) for tone in Tone)
SHOWN_ROWS = slice(32, 96)
"""Rows to show: the middle half of a field, as a press is at most half as thick as the field is high."""
SHOWN_MM = tuple(round(mm, 3) for mm in (-ANCHOR_MM[0], -0.25 * FIELD_MM, FIELD_MM, 0.5 * FIELD_MM))
"""Left, top, width and height of these rows, y downward from the point of touch."""


def field_around(anchor_mm: tuple[float, float]) -> tuple[float, float, float, float]:
    """(x, y, width, height) in mm of the field around a zero-touch point, both in the paper frame (y upward)."""
    left, top = ANCHOR_MM
    return anchor_mm[0] - left, anchor_mm[1] - (FIELD_MM - top), FIELD_MM, FIELD_MM


def field_grid() -> Grid:
    """The pixel centres of the millimetre field around the point of touch."""
    left, top = ANCHOR_MM
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * MM_PER_PX, np.float64)
    return Grid(np.asarray(centres - left), np.asarray(top - centres))


def captured(prepared: Prepared) -> Pixels:
    """(len(KEYS), 128, 128) images of a capture that was rectified to the field.

    If size-normalised, the stroke's length is scaled to 100 px and its bounding box is in the middle.
    """
    rows, columns = np.flatnonzero(prepared.mask.any(axis=1)), np.flatnonzero(prepared.mask.any(axis=0))
    step_px = (columns[-1] + 1 - columns[0]) / NORMAL_LENGTH_PX
    # Centre without rounding: an offset of half a pixel costs a perfect model several points of SSIM.
    middle = 0.5 * (columns[0] + columns[-1] + 1), 0.5 * (rows[0] + rows[-1] + 1)
    left, top = (float(at - 0.5 * SIZE_PX * step_px) for at in middle)
    images: list[Pixels] = []
    for alignment, tone in KEYS:
        ink = prepared.soft if tone is Tone.GRAY else prepared.mask.astype(np.float32)
        aligned = shrunk(ink) if alignment is Alignment.MM else averaged(ink, (left, top), step_px, SIZE_PX)
        images.append(to_pixels(to_tone(aligned, tone)))
    return np.stack(images)


def averaged(
    image: NDArray[np.float32], corner_px: tuple[float, float], step_px: float, size_px: int, fine: int = FINE
) -> Image:
    """Average an image over (size_px, size_px) squares of `step_px` each, sampled `fine` times along each side.

    `corner_px` is their upper left corner, x and y.
    """
    scale = fine / step_px
    # cv2 puts pixel centres on integers, here a pixel covers [j, j + 1).
    left, top = (scale * (0.5 - corner) - 0.5 for corner in corner_px)
    move, side = np.array([[scale, 0.0, left], [0.0, scale, top]]), fine * size_px
    return shrunk(cv2.warpAffine(image, move, (side, side), flags=cv2.INTER_LINEAR), size_px)


def shrunk(image: cv2.typing.MatLike, size_px: int = SIZE_PX) -> Image:
    """The mean of an image over (size_px, size_px) squares."""
    return cast("Image", cv2.resize(image, (size_px, size_px), interpolation=cv2.INTER_AREA))


def to_tone(coverage: Image, tone: Tone) -> Image:
    """Coverage unchanged, or 1 where a pixel is mostly ink."""
    return coverage if tone is Tone.GRAY else (coverage > 0.5).astype(np.float32)


def simulated(model: StrokeModel, depth_mm: float, tilt_deg: float) -> Pixels:
    """(len(KEYS), 128, 128) predictions of a press. May raise `model.ccdbsm.DomainError`.

    The press tilts about the tip, then descends: the brush axis meets the paper H tan(alpha) from the zero-touch point,
    toward the side the ferrule leans to.
    """
    return images_of(model.profile(depth_mm, tilt_deg), depth_mm * math.tan(math.radians(tilt_deg)))


def images_of(mark: Outline, origin_x_mm: float) -> Pixels:
    """(len(KEYS), 128, 128) images of a mark: its exact coverage.

    `origin_x_mm` is the distance of the mark's origin from the zero-touch point.
    """
    left, top = ANCHOR_MM
    x_min_mm, x_max_mm = float(mark.x_min_mm[0]), float(mark.x_max_mm[0])
    normal_mm = (x_max_mm - x_min_mm) / NORMAL_LENGTH_PX
    middle_mm, half_mm = 0.5 * (x_min_mm + x_max_mm), 0.5 * SIZE_PX * normal_mm
    gray = {
        Alignment.MM: coverage(mark, np.array([left + origin_x_mm, top]), px_mm=MM_PER_PX)[0],
        Alignment.SIZE_NORMALISED: coverage(mark, np.array([half_mm - middle_mm, half_mm]), px_mm=normal_mm)[0],
    }
    return np.stack([to_pixels(to_tone(gray[alignment], tone)) for alignment, tone in KEYS])


def shown(images: Pixels) -> Image:
    """The rows to show of the gray image on the millimetre field, of (len(KEYS), 128, 128)."""
    return np.asarray(images[MM_GRAY][SHOWN_ROWS] / 255.0, np.float32)


def brush_of(header: Header) -> Brush:
    """The brush that a recording names; missing sizes are those of the published brush."""
    nominal = Brush()
    return Brush(header.brush_radius_mm or nominal.radius_mm, header.brush_length_mm or nominal.length_mm)


def to_pixels(image: Image) -> Pixels:
    """Convert ink in [0, 1] to 256 levels, like the camera's."""
    return np.rint(255.0 * image).astype(np.uint8)


def similarity(
    captured: NDArray[Any], others: NDArray[Any], alignment: Alignment, polarity: Polarity = Polarity.INK
) -> NDArray[np.float64]:
    """(n, 2) CSIM and SSIM of an image (h, w) and each of n >= 1 others (n, h, w) of one alignment.

    NaN where one is blank. If size-normalised, the others are shifted to best overlap.
    """
    scores = np.empty((len(others), 2))
    fixed = 1.0 - captured if polarity is Polarity.PAPER else captured
    for few in (slice(k, k + AT_ONCE) for k in range(0, len(others), AT_ONCE)):
        moved = best_shift(others[few], captured) if alignment is Alignment.SIZE_NORMALISED else others[few]
        blank = ~(moved.any(axis=(1, 2)) & captured.any())
        scores[few] = csim_and_ssim(fixed, 1.0 - moved if polarity is Polarity.PAPER else moved)
        scores[few][blank] = np.nan
    return scores


def best_shift(moving: NDArray[Any], fixed: NDArray[Any]) -> NDArray[Any]:
    """Shift each of (n, h, w) by at most 6 px each way so that its overlap with (h, w) is largest.

    Of equally good shifts the least is taken. Overlaps are those of 256 levels, in whole numbers, so that ties are
    always broken in the same way.
    """
    import scipy.fft  # slow to import, and a collecting rig compares nothing by shift

    reach, window = BEST_SHIFT_PX, inked_window(fixed, moving, BEST_SHIFT_PX)
    a, b = (np.rint(255.0 * image[..., *window]) for image in (fixed, moving))
    size = [scipy.fft.next_fast_len(side + reach, real=True) for side in a.shape]
    overlap = scipy.fft.irfft2(np.conj(scipy.fft.rfft2(a, size)) * scipy.fft.rfft2(b, size), size)
    shifts = SHIFTS[np.rint(overlap[:, *SHIFTS.T]).argmax(axis=1)]
    padded, (height, width) = np.pad(moving, ((0, 0), (reach, reach), (reach, reach))), fixed.shape
    corners = zip(padded, (shifts + reach).tolist(), strict=True)
    return np.stack([image[row : row + height, column : column + width] for image, (row, column) in corners])


@dataclass(frozen=True, slots=True)
class Printed:
    """A row of the CCD-BSMG paper's tables, in percent; the paper used its own brush, ink and preprocessing."""

    label: str
    csim: tuple[float, float, float]
    """Max, min, avg."""
    ssim: tuple[float, float, float]


ROBOT_WRITING = "robot writing"
TABLE_1: dict[str, Printed] = {
    "ccd-bsm": Printed("CCD-BSM", (94.25, 88.33, 91.84), (90.13, 85.16, 87.71)),
    "ccd-bsmg": Printed("CCD-BSMG", (97.29, 89.22, 92.65), (90.58, 85.49, 88.16)),
    ROBOT_WRITING: Printed("robot writing", (98.21, 89.42, 93.31), (95.62, 85.85, 90.12)),
}
"""Generated strokes, and strokes pressed again with the recovered (H, alpha), against real strokes."""
TABLE_2: dict[str, Printed] = {
    "ccd-bsmg": TABLE_1["ccd-bsmg"],
    "ccd-bsm": TABLE_1["ccd-bsm"],
    "bezier": Printed("Bézier", (90.36, 85.48, 88.02), (83.14, 78.21, 81.03)),
    "ellipse": Printed("Ellipse", (86.43, 81.62, 84.15), (76.81, 71.05, 73.46)),
    "circle": Printed("Circle", (71.40, 64.36, 67.03), (63.85, 57.21, 60.23)),
    "line": Printed("Line", (85.99, 81.26, 83.50), (77.38, 67.22, 72.77)),
}
"""Every model against real strokes."""
TABLE_3: dict[str, Printed] = {
    "ccd-bsmg": Printed("CCD-BSMG", (97.71, 91.45, 94.58), (79.26, 72.56, 75.91)),
    ROBOT_WRITING: Printed("robot writing", (95.82, 91.36, 93.59), (78.78, 70.42, 74.60)),
}
"""The character zi. The paper does not say what each row was compared with, nor whether it wrote 字 or 子, nor its
polarity: the pairing of its rows with ours is our interpretation."""
