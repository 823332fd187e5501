"""The newest capture as a screen shows it: what was photographed, what was found in it, and how it was judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibrate.compare.field import SIZE_PX, Field, Tone, captured_mm
from calibrate.compare.similarity import csim
from calibrate.errors import CaptureRefused
from calibrate.stroke.preprocess import Params, prepare, rectify
from collect.quality.verdict import Verdict
from collect.rig.paper import Cell
from model.fitted import FittedPress

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from calibrate.board.plane import Plane
    from calibrate.stroke.preprocess import Gray

PX_PER_MM = 20.0
FINE = 8


@dataclass(frozen=True, slots=True)
class LastCapture:
    """One capture."""

    stroke_id: str
    height_mm: float
    tilt_deg: float
    still: int
    kept: bool
    verdict: Verdict | None
    """None where captures are not judged."""
    photo: NDArray[np.uint8] | None = None
    """(h, w) gray of the field around the zero-touch point, seen from above."""
    binary: NDArray[np.bool_] | None = None
    """(128, 128) true where ink: the image that a validation compares, in the millimetre alignment."""
    model: NDArray[np.bool_] | None = None
    """(128, 128) of CCD-BSM as published, for the same H and alpha; None for a figure, or beyond what it can draw."""

    @property
    def likeness(self) -> float | None:
        """CSIM of `binary` and `model`, 0 to 1."""
        if self.binary is None or self.model is None or not (self.binary.any() and self.model.any()):
            return None
        return csim(self.binary.astype(float), self.model.astype(float))


def published_mark(
    height_mm: float, tilt_deg: float, *, radius_mm: float, length_mm: float
) -> NDArray[np.bool_] | None:
    """CCD-BSM as published, (128, 128) on the default field; None where it draws no mark. A few milliseconds."""
    press, field = FittedPress(radius_mm, length_mm), Field()
    left, top = field.anchor_mm
    centres = (np.arange(FINE * SIZE_PX) + 0.5) * (field.mm_per_px / FINE)
    try:
        half_mm = press.half_width(height_mm, tilt_deg, np.asarray(centres - left, np.float64))
    except ValueError:
        return None
    fine = np.abs(top - centres)[:, None] <= half_mm[None]
    return np.asarray(fine.reshape(SIZE_PX, FINE, SIZE_PX, FINE).mean(axis=(1, 3)) > 0.5)


def pictures_of(image: Gray, plane: Plane, cell: Cell) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The field around the cell's zero-touch point, and its ink on 128 x 128; no ink where none is found."""
    field = Field()
    window = field.window_mm(cell.anchor_mm)
    raster = rectify(image, plane.image_to_paper, window)
    left, _, _, height = window
    anchor = ((cell.anchor_mm[0] - left) * PX_PER_MM, (window[1] + height - cell.anchor_mm[1]) * PX_PER_MM)
    x, y, width, tall = cell.rect_mm
    cell_px = (
        round((x - left) * PX_PER_MM),
        round((window[1] + height - y - tall) * PX_PER_MM),
        round(width * PX_PER_MM),
        round(tall * PX_PER_MM),
    )
    try:
        prepared = prepare(raster, anchor, "the capture", Params(), cell_px)
    except CaptureRefused:
        return raster, None
    return raster, captured_mm(prepared, Tone.BINARY) > 0.5
