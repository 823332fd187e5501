"""The 128 x 128 images that are compared, and how a captured stroke is placed on them.

Two alignment protocols: `mm` keeps millimetres and the zero-touch anchor; `size-normalised` scales each image to one
length and then takes the best shift. The second reproduces the spread in the paper; the first is the honest one.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.params import PX_PER_MM
from brushloop.calibrate.stroke.preprocess import Prepared

Image = NDArray[np.float32]
SIZE_PX = 128
NORMAL_LENGTH_PX = 100
BEST_SHIFT_PX = 6
FINE = 4
"""Oversampling: strokes are moved on a raster finer by this factor, near their own 20 px/mm, then area-averaged."""


class Alignment(StrEnum):
    """How captured and simulated images are aligned."""

    MM = "mm"
    SIZE_NORMALISED = "size-normalised"


class Tone(StrEnum):
    """Meaning of a pixel's value."""

    BINARY = "binary"
    GRAY = "gray"


Key = tuple[Alignment, Tone]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone))
"""Every way in which two images are compared."""


@dataclass(frozen=True, slots=True)
class Field:
    """The millimetre field: 128 x 128 px around the zero-touch point."""

    mm_per_px: float = MM_PER_PX
    anchor_share: tuple[float, float] = (0.76, 0.5)
    """Position of the zero-touch point, as a share of the field from the left and from the top."""

    @property
    def side_mm(self) -> float:
        """Width and height."""
        return SIZE_PX * self.mm_per_px

    @property
    def anchor_mm(self) -> tuple[float, float]:
        """Distance of the zero-touch point from the left and from the top."""
        return self.anchor_share[0] * self.side_mm, self.anchor_share[1] * self.side_mm

    def window_mm(self, anchor: tuple[float, float]) -> tuple[float, float, float, float]:
        """(x, y, width, height) of the field around an anchor, both in the paper frame (y upward)."""
        left, top = self.anchor_mm
        return anchor[0] - left, anchor[1] - (self.side_mm - top), self.side_mm, self.side_mm

    def corner_px(self, anchor_px: tuple[float, float]) -> tuple[int, int]:
        """First column and row of the field around an anchor, both on the 20 px/mm raster."""
        left, top = self.anchor_mm
        return round(anchor_px[0] - left * PX_PER_MM), round(anchor_px[1] - top * PX_PER_MM)

    def corner_around_px(self, mask: NDArray[np.bool_]) -> tuple[int, int]:
        """The same for a stroke without an anchor: the field is centred on the stroke's bounding box."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        side = round(self.side_mm * PX_PER_MM)
        return int(columns[0] + columns[-1] + 1 - side) // 2, int(rows[0] + rows[-1] + 1 - side) // 2


def crop(prepared: Prepared, corner_px: tuple[int, int], view: Field) -> Prepared:
    """Crop a raster to the field that begins at a corner; `cut` is set where ink is left out."""
    side, (height, width) = round(view.side_mm * PX_PER_MM), prepared.mask.shape
    left, top = min(max(corner_px[0], -side), width), min(max(corner_px[1], -side), height)
    window = slice(top + side, top + 2 * side), slice(left + side, left + 2 * side)
    mask, soft = (np.pad(part, side)[window] for part in (prepared.mask, prepared.soft))
    anchor = prepared.anchor_px
    return replace(
        prepared,
        mask=mask,
        soft=soft,
        anchor_px=None if anchor is None else (anchor[0] - left, anchor[1] - top),
        cut=prepared.cut or bool(np.count_nonzero(mask) < np.count_nonzero(prepared.mask)),
    )


def crop_at_anchor(prepared: Prepared, anchor_px: tuple[float, float], view: Field) -> Prepared:
    """Crop to the field around an anchor. Raises `CaptureRefused` if the stroke lies outside it."""
    cropped = crop(prepared, view.corner_px(anchor_px), view)
    if not cropped.mask.any():
        raise CaptureRefused("anchor", "lies so far from the stroke that none of it is in the field")
    return cropped


def covered(prepared: Prepared) -> Image:
    """(128, 128) share of each pixel that is ink in a capture that was rectified to the field."""
    return _shrunk(prepared.mask.astype(np.float32))


def captured_mm(prepared: Prepared, tone: Tone) -> Image:
    """(128, 128) image of a capture that was rectified to the field."""
    return to_tone(_shrunk(prepared.soft) if tone is Tone.GRAY else covered(prepared), tone)


def captured_normalised(prepared: Prepared, tone: Tone) -> Image:
    """(128, 128) image with the stroke's length scaled to 100 px and its bounding box in the middle."""
    rows, columns = np.flatnonzero(prepared.mask.any(axis=1)), np.flatnonzero(prepared.mask.any(axis=0))
    source = prepared.soft if tone is Tone.GRAY else prepared.mask.astype(np.float32)
    scale = FINE * NORMAL_LENGTH_PX / (columns[-1] + 1 - columns[0])
    # Centre without rounding: an offset of half a pixel costs a perfect model several points of SSIM. cv2 puts pixel
    # centres on integers; here a pixel covers [j, j + 1).
    x, y = 0.5 * (columns[0] + columns[-1] + 1), 0.5 * (rows[0] + rows[-1] + 1)
    middle = 0.5 * FINE * SIZE_PX
    move = np.array([[scale, 0.0, middle - 0.5 - scale * (x - 0.5)], [0.0, scale, middle - 0.5 - scale * (y - 0.5)]])
    fine = cv2.warpAffine(source, move, (FINE * SIZE_PX, FINE * SIZE_PX), flags=cv2.INTER_LINEAR)
    return to_tone(_shrunk(fine), tone)


def _shrunk(image: cv2.typing.MatLike) -> Image:
    return cast("Image", cv2.resize(image, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA))


def to_tone(coverage: Image, tone: Tone) -> Image:
    """Coverage unchanged, or 1 where a pixel is mostly ink."""
    return coverage if tone is Tone.GRAY else (coverage > 0.5).astype(np.float32)


def best_shift(moving: Image, fixed: Image) -> Image:
    """Shift `moving` by at most 6 px each way so that its overlap with `fixed` is largest, and of equals the least."""
    from brushloop.calibrate.compare.compiled import shift_to_overlap  # numba takes a fifth of a second to import

    reach = BEST_SHIFT_PX
    a, b = (np.rint(255.0 * image).astype(np.uint8) for image in (fixed, moving))
    row, column = shift_to_overlap(a, b, reach)
    return np.pad(moving, reach)[reach + row :, reach + column :][:SIZE_PX, :SIZE_PX]
