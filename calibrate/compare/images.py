"""Images of a press for every alignment and tone: as it was captured, and as a model predicts it.

The modules of `model` load torch, which workers that only prepare captures do not need, so they are imported late.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.field import (
    KEYS,
    NORMAL_LENGTH_PX,
    SIZE_PX,
    Alignment,
    Field,
    Image,
    Key,
    captured_mm,
    captured_normalised,
    crop_at_anchor,
    to_tone,
)
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.params import PX_PER_MM, Gray, Params
from brushloop.calibrate.stroke.preprocess import Prepared, Steps, prepare, preprocess
from brushloop.calibrate.stroke.rectify import on_raster, on_window, rectify_by, rescale
from brushloop.model.brush import Brush
from brushloop.model.loops import Loop
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Header

if TYPE_CHECKING:
    from brushloop.model.outline import Shape
    from brushloop.model.strokes import StrokeModel

Pixels = NDArray[np.uint8]
"""Ink from 0 to 255."""
SPECK_SHARE = 0.002
"""Smallest share of a figure's ink that counts; lower than for a press, because a figure may have dots."""
MAX_UNPACKED_BYTES = 256 * (len(KEYS) + 1) * SIZE_PX**2


def rectified(capture: Capture, calibration: Calibration | None, view: Field) -> tuple[Gray, Steps]:
    """The surroundings of a stroke at 20 px/mm, (h, w) gray, and what was found in them.

    A press is cropped to the field around its zero-touch point, a stroke that travels to its paper cell; an imported
    photograph is rescaled whole. Raises `CaptureRefused` for a capture that cannot be used, `SessionDamaged` for a
    picture that cannot be read.
    """
    stroke, image, params = capture.stroke, capture.image(), Params.of(calibration)
    if calibration is not None and stroke.anchor_mm is not None:
        window, (left_mm, top_mm) = view.window_mm(stroke.anchor_mm), view.anchor_mm
        if stroke.kind == "drag" and stroke.cell_mm is not None:
            window = x_mm, y_mm, _, height_mm = stroke.cell_mm
            left_mm, top_mm = stroke.anchor_mm[0] - x_mm, y_mm + height_mm - stroke.anchor_mm[1]
        raster = rectify_by(image, calibration, window, capture.where)
        cell_px = None if stroke.cell_mm is None else on_window(stroke.cell_mm, window)
        anchor = (left_mm * PX_PER_MM, top_mm * PX_PER_MM)
        return raster, preprocess(raster, anchor, capture.where, params, cell_px)
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has neither a calibration nor a scale of its own")
    raster = rescale(image, stroke.px_per_mm, capture.where)
    anchor = None if stroke.anchor_px is None else on_raster(stroke.anchor_px, stroke.px_per_mm)
    return raster, preprocess(raster, anchor, capture.where, params)


def prepare_press(capture: Capture, calibration: Calibration | None, view: Field) -> Prepared:
    """Rectify a stroke to the millimetre field. Raises as `rectified` does."""
    stroke = capture.stroke
    if capture.bad:
        raise CaptureRefused(stroke.stroke_id, capture.bad)
    _, steps = rectified(capture, calibration, view)
    if calibration is not None and stroke.anchor_mm is not None:
        return steps.prepared
    if steps.prepared.anchor_px is None:
        raise CaptureRefused(stroke.stroke_id, "has no anchor (start_x_px, start_y_px): it cannot be laid on a model")
    return crop_at_anchor(steps.prepared, steps.prepared.anchor_px, view)


def prepare_cell(capture: Capture, calibration: Calibration) -> Prepared:
    """Rectify a whole paper cell: all ink in it belongs to its figure, however far apart the strokes are.

    Raises `CaptureRefused` for a stroke without a cell, or without ink in it.
    """
    cell_mm = capture.stroke.cell_mm
    if cell_mm is None:
        raise CaptureRefused(capture.stroke.stroke_id, "has no paper cell")
    raster = rectify_by(capture.image(), calibration, cell_mm, capture.where)
    whole = {"join_mm": math.hypot(*cell_mm[2:]), "speck_share": SPECK_SHARE}
    return prepare(raster, None, capture.where, Params(**(calibration.preprocess | whole)))


def captured_images(stroke_id: str, prepared: Prepared) -> dict[Key, Image]:
    """A prepared press in every alignment and tone, (128, 128) each. Raises `CaptureRefused` if one would be blank."""
    images: dict[Key, Image] = {}
    for alignment, tone in KEYS:
        image = (captured_mm if alignment is Alignment.MM else captured_normalised)(prepared, tone)
        if not to_pixels(image).any():
            raise CaptureRefused(stroke_id, f"is too thin to be seen at the scale of {alignment} ({tone})")
        images[alignment, tone] = image
    return images


def simulated(model: StrokeModel, depth_mm: float, tilt_deg: float, field: Field) -> dict[Key, Image]:
    """Predictions of a press in every alignment and tone, (128, 128) each. May raise `model.brush.DomainError`."""
    gray = drawn(loop_of(model.profile(depth_mm, tilt_deg)), axis_mm(depth_mm, tilt_deg), field)
    return {(alignment, tone): to_tone(gray[alignment], tone) for alignment, tone in KEYS}


def simulated_pixels(model: StrokeModel, depth_mm: float, tilt_deg: float, field: Field) -> Pixels:
    """(len(KEYS), 128, 128) predictions of a press. May raise `model.brush.DomainError`."""
    return key_pixels(simulated(model, depth_mm, tilt_deg, field))


def loop_pixels(loop: Loop, field: Field) -> Pixels:
    """(len(KEYS), 128, 128) of a mark whose x is from the zero-touch point."""
    gray = drawn(loop, 0.0, field)
    return key_pixels({(alignment, tone): to_tone(gray[alignment], tone) for alignment, tone in KEYS})


def key_pixels(images: dict[Key, Image]) -> Pixels:
    """Images of every key as levels, (len(KEYS), 128, 128)."""
    return np.stack([to_pixels(images[key]) for key in KEYS])


def loop_of(shape: Shape) -> Loop:
    """The outline of a shape, as numbers without gradients."""
    outline, ends = shape.outline(), (shape.x_min_mm, shape.x_max_mm)
    points, weights = (part[0].detach().double().cpu().numpy() for part in (outline.points, outline.weights))
    return Loop(points, weights, *(float(end[0]) for end in ends))


def axis_mm(depth_mm: float, tilt_deg: float) -> float:
    """Distance from the zero-touch point to where the brush axis meets the paper, toward the side the ferrule leans to.

    The press tilts about the tip, then descends.
    """
    return depth_mm * math.tan(math.radians(tilt_deg))


def drawn(loop: Loop, origin_x_mm: float, field: Field) -> dict[Alignment, Image]:
    """(128, 128) exact coverage of a mark in each alignment.

    `origin_x_mm` is the distance of the mark's origin from the zero-touch point.
    """
    left, top = field.anchor_mm
    middle_mm, normal_mm = 0.5 * (loop.x_min_mm + loop.x_max_mm), (loop.x_max_mm - loop.x_min_mm) / NORMAL_LENGTH_PX
    side_mm = SIZE_PX * normal_mm
    views = ((field.mm_per_px, left + origin_x_mm, top), (normal_mm, 0.5 * side_mm - middle_mm, 0.5 * side_mm))
    return dict(zip((Alignment.MM, Alignment.SIZE_NORMALISED), draw_loop(loop, views, SIZE_PX), strict=True))


def draw_loop(loop: Loop, views: Sequence[tuple[float, float, float]], size_px: int) -> NDArray[np.float32]:
    """Exact coverage of a mark in each view, (mm per pixel, x and y of its origin from the upper left corner, mm)."""
    from brushloop.model.raster import kernel  # numba takes a fifth of a second to import

    maps = np.array([[1 / px, 0.0, x / px, 0.0, -1 / px, y / px] for px, x, y in views])
    points, weights = (np.stack([part] * len(maps)) for part in (loop.points, loop.weights))
    out = np.empty((len(maps), size_px, size_px), np.float32)
    untyped: Any = kernel
    untyped.rasterise(points, weights, maps, out)
    return out


def brush_of(header: Header) -> Brush:
    """The brush that a recording names; missing sizes are those of the published brush."""
    nominal = Brush()
    return Brush(
        radius_mm=header.brush_radius_mm or nominal.radius_mm, length_mm=header.brush_length_mm or nominal.length_mm
    )


def to_pixels(image: Image) -> Pixels:
    """Convert ink in [0, 1] to 256 levels, like the camera's."""
    return np.rint(255.0 * image).astype(np.uint8)


def pack(images: Pixels) -> bytes:
    """Compress (n, 128, 128) images, which are mostly blank paper."""
    return zlib.compress(np.ascontiguousarray(images).tobytes(), 1)


def unpack(packed: bytes) -> Pixels:
    """Decompress (n, 128, 128) images from `pack`. Raises ValueError for anything else."""
    try:
        inflater = zlib.decompressobj()
        raw = inflater.decompress(packed, MAX_UNPACKED_BYTES)
    except zlib.error as error:
        raise ValueError(f"not packed images: {error}") from None
    if not inflater.eof or len(raw) % SIZE_PX**2:
        raise ValueError("not packed images of 128 x 128 pixels")
    return np.frombuffer(raw, np.uint8).reshape(-1, SIZE_PX, SIZE_PX)
