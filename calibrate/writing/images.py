"""A written character as the images that are compared: its paper cell, or the character scaled to one size."""

from __future__ import annotations

import itertools
import math
from enum import StrEnum
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from calibrate.calibration import Calibration
from calibrate.compare.field import SIZE_PX, Alignment, Image, Tone, best_shift, to_tone
from calibrate.compare.similarity import csim, ssim
from calibrate.errors import CalibrationError, CaptureRefused
from calibrate.files import read_gray
from calibrate.stroke.params import Params
from calibrate.stroke.preprocess import Prepared, prepare
from calibrate.stroke.rectify import rectify
from sessions.reader import Capture

NORMAL_SIDE_PX = 100
SPECK_SHARE = 0.002
"""A dot of a dense character is smaller against its longest stroke than a drop against a press."""


class Polarity(StrEnum):
    """Which of ink and paper is 1."""

    INK = "ink = 1"
    PAPER = "paper = 1"


Key = tuple[Alignment, Tone, Polarity]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone, Polarity))
Ink = dict[Tone, Image]
"""(128, 128) ink of a cell from 0 to 1 by tone: coverage of what counts as ink, and how dark it is."""


def captured(capture: Capture, calibration: Calibration) -> tuple[Ink, bool]:
    """What lies on the character's paper cell, and whether it reaches the edge. Raises `CaptureRefused`."""
    stroke = capture.stroke
    if stroke.cell_mm is None:
        raise CaptureRefused(stroke.stroke_id, "tells no paper cell")
    _, _, width_mm, height_mm = stroke.cell_mm
    if not math.isclose(width_mm, height_mm):
        raise CaptureRefused(stroke.stroke_id, f"its cell is {width_mm:g} x {height_mm:g} mm, a square is needed")
    raster = rectify(capture.image(), calibration.homography(), stroke.cell_mm)
    prepared = _whole_cell(raster, capture.where, calibration, math.hypot(width_mm, height_mm))
    return {Tone.BINARY: _small(prepared.mask.astype(np.float32)), Tone.GRAY: _small(prepared.soft)}, prepared.cut


def _small(image: Image) -> Image:
    return cast("Image", cv2.resize(image, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA))


def _whole_cell(raster: np.ndarray, where: str, calibration: Calibration, reach_mm: float) -> Prepared:
    """All ink of the cell is the character's, however far its strokes lie apart."""
    told = calibration.preprocess | {"join_mm": reach_mm, "speck_share": SPECK_SHARE}
    return prepare(raster.astype(np.uint8), None, where, Params(**told))


def read_reference(path: Path) -> Image:
    """(128, 128) ink of a picture of a character, dark on light, padded to a square. Raises `CalibrationError`."""
    gray = read_gray(path)
    ink = 1.0 - gray.astype(np.float32) / 255.0
    if float(ink.mean()) > 0.5:
        raise CalibrationError(str(path), "is mostly dark: a reference is dark ink on light paper")
    height, width = ink.shape
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    square = np.pad(ink, ((top, side - height - top), (left, side - width - left)))
    return _small(square)


def drawn(image: Image) -> Ink:
    """Of an image that was not photographed: as dark as covered."""
    return dict.fromkeys(Tone, image)


def laid(ink: Image, alignment: Alignment) -> Image:
    """(128, 128) as it is, or with the longer side of its ink scaled to 100 px and its bounding box in the middle."""
    if alignment is Alignment.MM:
        return ink
    rows, columns = np.flatnonzero((ink > 0.5).any(axis=1)), np.flatnonzero((ink > 0.5).any(axis=0))
    if not rows.size:
        raise ValueError("holds no ink")
    scale = NORMAL_SIDE_PX / (1 + max(rows[-1] - rows[0], columns[-1] - columns[0]))
    x, y = 0.5 * (columns[0] + columns[-1] + 1), 0.5 * (rows[0] + rows[-1] + 1)
    middle = 0.5 * SIZE_PX
    # cv2 puts pixel centres on integers, a pixel here covers [j, j + 1).
    move = np.array([[scale, 0.0, middle - 0.5 - scale * (x - 0.5)], [0.0, scale, middle - 0.5 - scale * (y - 0.5)]])
    return cast("Image", cv2.warpAffine(ink, move, (SIZE_PX, SIZE_PX), flags=cv2.INTER_LINEAR).clip(0.0, 1.0))


def similarity(fixed: Ink, moving: Ink, key: Key) -> tuple[float, float]:
    """(CSIM, SSIM) of what lies on two cells. Raises ValueError for a blank one."""
    alignment, tone, polarity = key
    one, other = (to_tone(laid(image[tone], alignment), tone) for image in (fixed, moving))
    if alignment is Alignment.SIZE_NORMALISED:
        other = best_shift(other, one)
    if not one.any() or not other.any():
        raise ValueError("a blank image")
    if polarity is Polarity.PAPER:
        one, other = 1.0 - one, 1.0 - other
    return csim(one, other), ssim(one, other)
