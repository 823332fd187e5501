"""New ink between two photographs of a sheet: its amount at given places, and its marks anywhere in view.

Sums over an area are unbiased: nothing is clipped or thresholded before them, since zero touch relies on fractions of
a square millimetre. `quality.ink` compares masks of ink instead, and `calibrate.stroke.difference` cuts out one stroke.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, apply
from brushloop.calibrate.board.pix2len import local_scale, see_board
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stroke import PX_PER_MM
from brushloop.calibrate.stroke.rectify import rectify
from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.optics import Gray, undistorted
from brushloop.drivers.devices import Frame

DARK_SHARE = 0.5
"""Pixels darker than this share of the paper are not paper, and are ignored in measuring the change of light."""
DARKER = 0.2
"""Share of the paper's brightness that a pixel must have lost to belong to a mark."""
JOIN_MM = 1.5
"""Parts that lie closer together belong to one mark."""


def before_and_after(config: RigConfig, before: Frame, after: Frame) -> tuple[Gray, Gray, Floats]:
    """Return both photographs, gray and undistorted, and the (3, 3) map from the second one to the paper frame.

    Raises `StepError` if the board is not seen.
    """
    first, second = (undistorted(config.camera, frame.image) for frame in (before, after))
    try:
        return first, second, see_board(second, config.board).homography
    except CalibrationError as error:
        raise StepError(f"the board is not seen: {error.what}") from None


def _darkening(first: NDArray[np.float32], second: NDArray[np.float32]) -> tuple[NDArray[np.float32], float] | None:
    """Return (gray levels by which each pixel became darker, level of the paper), corrected for the light.

    None for pictures that show no paper.
    """
    paper = float(np.quantile(first, 0.9))
    clean = first > DARK_SHARE * paper
    if paper < 1.0 or not clean.any():
        return None
    light = float(np.median(second[clean] / first[clean]))
    return np.asarray(first - second / max(light, 1e-3), np.float32), paper


def new_ink(
    before: Gray, after: Gray, image_to_paper: Floats, window_mm: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """How much darker a window (x, y, width, height in the paper frame) became, (h, w) at 20 px/mm.

    As a share of the paper's brightness: 1 is paper turned black. Noise averages to 0.
    """
    first, second = (rectify(image, image_to_paper, window_mm).astype(np.float32) for image in (before, after))
    found = _darkening(first, second)
    if found is None:
        return np.zeros(first.shape, np.float32)
    darkening, paper = found
    return np.asarray(darkening / paper, np.float32)


def ink_at(
    before: Gray, after: Gray, image_to_paper: Floats, spots_mm: list[tuple[float, float]], side_mm: float
) -> Floats:
    """New ink in a square around each spot, (n,) in mm2 of black."""
    amounts: list[float] = []
    for x, y in spots_mm:
        # Larger by one side all around, so that the median sees paper.
        window = (x - 1.5 * side_mm, y - 1.5 * side_mm, 3.0 * side_mm, 3.0 * side_mm)
        darker = new_ink(before, after, image_to_paper, window)
        third = darker.shape[0] // 3
        amounts.append(float(darker[third : 2 * third, third : 2 * third].sum()) / PX_PER_MM**2)
    return np.array(amounts, np.float64)


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark of new ink: its centroid, weighted by darkness, in the paper frame, and its mm2 of black."""

    x_mm: float
    y_mm: float
    ink_mm2: float


def new_marks(before: Gray, after: Gray, image_to_paper: Floats, least_ink_mm2: float) -> list[Mark]:
    """New marks of at least `least_ink_mm2`, the largest first. The camera must not have moved in between."""
    first, second = before.astype(np.float32), after.astype(np.float32)
    found = _darkening(first, second)
    if found is None:
        return []
    darkening, paper = found
    darker = np.asarray(darkening / np.maximum(first, DARK_SHARE * paper), np.float32)
    height, width = darker.shape
    middle = np.array([0.5 * width, 0.5 * height])
    reach_px = max(1, round(0.5 * JOIN_MM / local_scale(lambda at: apply(image_to_paper, at), middle)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1, 2 * reach_px + 1))
    joined = cv2.dilate((darker > DARKER).astype(np.uint8), kernel)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    parts = np.asarray(labels, np.int32)
    marks = [_mark(darker, parts, label, boxes[label], image_to_paper) for label in range(1, count)]
    return sorted((m for m in marks if m.ink_mm2 >= least_ink_mm2), key=lambda m: -m.ink_mm2)


def _mark(
    darker: NDArray[np.float32], labels: NDArray[np.int32], label: int, box: cv2.typing.MatLike, image_to_paper: Floats
) -> Mark:
    x, y, width, height = (int(v) for v in box[:4])
    part = (slice(y, y + height), slice(x, x + width))
    # Noise averages to 0: without clipping, the margin that joining added has no weight.
    weights = np.where(labels[part] == label, darker[part], 0.0).astype(np.float64)
    total = float(weights.sum())
    if total <= 0.0:
        return Mark(0.0, 0.0, 0.0)
    rows, columns = np.mgrid[y : y + height, x : x + width]
    pixel = np.array([float((columns * weights).sum()), float((rows * weights).sum())]) / total
    [[x_mm, y_mm]] = apply(image_to_paper, pixel[None])
    return Mark(float(x_mm), float(y_mm), total * local_scale(lambda at: apply(image_to_paper, at), pixel) ** 2)
