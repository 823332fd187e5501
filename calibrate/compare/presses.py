"""A captured press on the millimetre field: found on its photograph, rectified, laid on its point of touch."""

from __future__ import annotations

from calibrate.calibration import Calibration
from calibrate.compare.field import Field, crop_at_anchor
from calibrate.errors import CaptureRefused
from calibrate.stroke.params import PX_PER_MM, Params
from calibrate.stroke.preprocess import Prepared, prepare
from calibrate.stroke.rectify import on_raster, on_window, rectify_by, rescale
from sessions.reader import Capture
from sessions.recording.schemas import Stroke


def prepare_press(capture: Capture, calibration: Calibration | None, params: Params, view: Field) -> Prepared:
    """The stroke on the millimetre field, rectified by the calibration or by the import's own scale.

    Raises `CaptureRefused` for a capture that cannot be used, `SessionDamaged` for a picture that cannot be read.
    """
    stroke = capture.stroke
    if capture.bad:
        raise CaptureRefused(stroke.stroke_id, capture.bad)
    image = capture.image()
    left, top = (v * PX_PER_MM for v in view.anchor_mm)
    if stroke.anchor_mm is not None and calibration is not None:
        window = view.window_mm(stroke.anchor_mm)
        raster = rectify_by(image, calibration, window, capture.where)
        return prepare(raster, (left, top), capture.where, params, _cell_px(stroke, window))
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has neither a calibration nor a scale of its own")
    raster = rescale(image, stroke.px_per_mm, capture.where)
    if stroke.anchor_px is None:
        raise CaptureRefused(stroke.stroke_id, "has no anchor (start_x_px, start_y_px): it cannot be laid on a model")
    anchor = on_raster(stroke.anchor_px, stroke.px_per_mm)
    return crop_at_anchor(prepare(raster, anchor, capture.where, params), anchor, view)


def _cell_px(stroke: Stroke, window: tuple[float, float, float, float]) -> tuple[int, int, int, int] | None:
    return None if stroke.cell_mm is None else on_window(stroke.cell_mm, window)
