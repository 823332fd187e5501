"""The newest capture as a screen shows it: its photograph, its ink beside the model's mark, and its verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from brushloop.calibrate.compare.place import SIZE_PX, Field, covered
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke import PX_PER_MM, Params
from brushloop.calibrate.stroke.preprocess import prepare
from brushloop.calibrate.stroke.rectify import rectify
from brushloop.collect.quality.checks import Verdict
from brushloop.collect.rig.paper import Patch
from brushloop.model.fitted import FittedPress
from brushloop.model.similarity import csim
from brushloop.sessions.events import Press
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brushloop.calibrate.board.pix2len import Plane
    from brushloop.calibrate.stroke import Gray

FIELD = Field()
FINE = 8
"""Points per pixel and axis at which the model's mark is evaluated."""


@dataclass(frozen=True, slots=True)
class LastCapture:
    """One capture, as a screen shows it."""

    press: Press
    still: int
    kept: bool
    verdict: Verdict | None
    """None where captures are not judged."""
    photo: NDArray[np.uint8] | None = None
    """(h, w) gray: the field around the zero-touch point, seen from above."""
    binary: NDArray[np.bool_] | None = None
    """(128, 128), true where there is ink: the image that a validation compares, in the millimetre alignment."""
    model: NDArray[np.bool_] | None = None
    """(128, 128) mark of CCD-BSM as published for the same H and alpha; None for a figure, or if it gives none."""

    @property
    def likeness(self) -> float | None:
        """CSIM of `binary` and `model`, 0 to 1; None if either shows no ink."""
        return likeness(self.binary, self.model)


def likeness(captured: NDArray[np.bool_] | None, predicted: NDArray[np.bool_] | None) -> float | None:
    """CSIM of two images of ink, 0 to 1; None if either is missing or shows no ink."""
    if captured is None or predicted is None or not (captured.any() and predicted.any()):
        return None
    return csim(captured.astype(float), predicted.astype(float))


def mark_of(brush: FittedPress, condition: Condition) -> NDArray[np.bool_] | None:
    """Mark of a brush, (128, 128) on the default field; None if the model gives none there. Takes a few ms.

    A brush of which only radius and length are given leaves the mark of CCD-BSM as published.
    """
    left, top = FIELD.anchor_mm
    centres = (np.arange(FINE * SIZE_PX) + 0.5) * (FIELD.mm_per_px / FINE)
    try:
        upper, lower = brush.edges_at(condition.depth_mm, condition.tilt_deg, np.asarray(centres - left, np.float64))
    except ValueError:
        return None
    up_mm = (top - centres)[:, None]
    edge_mm = np.asarray(np.where(up_mm > 0.0, upper, lower), np.float64)
    fine = np.abs(up_mm) <= edge_mm
    return np.asarray(fine.reshape(SIZE_PX, FINE, SIZE_PX, FINE).mean(axis=(1, 3)) > 0.5)


def pictures_of(image: Gray, plane: Plane, patch: Patch) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The field around the patch's zero-touch point, and its ink on 128 x 128 px, or None if there is no ink."""
    x, y, _, height = window = FIELD.window_mm(patch.anchor_mm)
    left, top = FIELD.anchor_mm
    raster = rectify(image, plane.homography, window)
    top_of_patch = y + height - (patch.y_mm + patch.size_y_mm)
    patch_px = (
        round((patch.x_mm - x) * PX_PER_MM),
        round(top_of_patch * PX_PER_MM),
        round(patch.size_x_mm * PX_PER_MM),
        round(patch.size_y_mm * PX_PER_MM),
    )
    anchor_px = left * PX_PER_MM, top * PX_PER_MM
    try:
        prepared = prepare(raster, anchor_px, "the capture", Params(), patch_px)
    except CaptureRefused:
        return raster, None
    return raster, covered(prepared) > 0.5
