"""Crops of a session's strokes for `brushloop sessions export --crops`: rectified, at 20 px/mm, each with its mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.field import Field
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stroke.params import PX_PER_MM, Gray, Params
from brushloop.calibrate.stroke.preprocess import Steps, preprocess
from brushloop.calibrate.stroke.rectify import on_raster, on_window, rectify_by, rescale
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.export import Crop, Cropper
from brushloop.sessions.messages import encode_png
from brushloop.sessions.recording import Capture, Recording


def cropper_of(recording: Recording, calibration_path: Path | None = None) -> Cropper:
    """Make the cropper of a recording, by the calibration given, else by the one in use.

    Raises `CalibrationError` where a session was not calibrated; an import needs no calibration.
    """
    first = next(recording.stroke_records())
    calibration = calibration_of(recording, first, recording.sha256, calibration_path)

    def crop(capture: Capture) -> Crop | str:
        try:
            return crop_capture(capture, calibration)
        except (CaptureRefused, SessionDamaged) as error:
            return error.what

    return crop


def crop_capture(capture: Capture, calibration: Calibration | None) -> Crop:
    """Crop a capture, as PNG. Raises as `rectified` does."""
    raster, steps = rectified(capture, calibration)
    mask = ink_of(capture, steps)
    prepared = steps.prepared
    return Crop(
        encode_png(raster),
        encode_png(255 * mask.astype(np.uint8)),
        PX_PER_MM,
        prepared.anchor_px,
        "; ".join(prepared.flags),
    )


def ink_of(capture: Capture, steps: Steps) -> NDArray[np.bool_]:
    """(h, w) ink: of a press its largest connected ink, as everywhere; of a stroke that travels all ink in its cell."""
    return steps.ink if capture.stroke.kind == "drag" else steps.prepared.mask


def rectified(capture: Capture, calibration: Calibration | None) -> tuple[Gray, Steps]:
    """The surroundings of a stroke at 20 px/mm, (h, w) gray, and what was found in them.

    A press is cropped to the field of `validate` around its zero-touch point, a stroke that travels to its paper cell;
    an imported photograph is rescaled whole. Raises `CaptureRefused` or `SessionDamaged`.
    """
    stroke, image = capture.stroke, capture.image()
    params = Params.of(calibration)
    cell_px = None
    if calibration is not None and stroke.anchor_mm is not None:
        window = Field().window_mm(stroke.anchor_mm)
        if stroke.kind == "drag" and stroke.cell_mm is not None:
            window = stroke.cell_mm
        raster = rectify_by(image, calibration, window, capture.where)
        left_mm, top_mm = stroke.anchor_mm[0] - window[0], window[1] + window[3] - stroke.anchor_mm[1]
        anchor = (left_mm * PX_PER_MM, top_mm * PX_PER_MM)
        cell_px = None if stroke.cell_mm is None else on_window(stroke.cell_mm, window)
    elif stroke.px_per_mm is not None:
        raster = rescale(image, stroke.px_per_mm, capture.where)
        anchor = None if stroke.anchor_px is None else on_raster(stroke.anchor_px, stroke.px_per_mm)
    else:
        raise CaptureRefused(stroke.stroke_id, "has neither a zero-touch point on the sheet nor a scale of its own")
    return raster, preprocess(raster, anchor, capture.where, params, cell_px)
