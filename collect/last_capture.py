"""The newest capture as a screen shows it: what was photographed, what was found in it, and how it was judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from calibrate.errors import CaptureRefused
from calibrate.field import Field, Tone, captured_mm
from calibrate.preprocess import Params, prepare, rectify
from collect.quality.verdict import Verdict
from collect.sheet import Cell

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibrate.preprocess import Gray
    from calibrate.scale import PlaneFit

PX_PER_MM = 20.0


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


def pictures_of(image: Gray, plane: PlaneFit, cell: Cell) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
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
