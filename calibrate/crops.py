"""Crops of a session's strokes for `brushloop sessions export --crops`: rectified, at 20 px/mm, each with its mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import Field, rectified
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stroke.params import PX_PER_MM
from brushloop.calibrate.stroke.preprocess import Steps
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
    raster, steps = rectified(capture, calibration, Field())
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
