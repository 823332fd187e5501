"""The 128 x 128 images that are compared: how a captured stroke and a predicted mark are placed on them.

Two alignment protocols: `mm` keeps millimetres and the zero-touch anchor; `size-normalised` scales each image to one
length and then takes the best shift. The second reproduces the spread in the paper; the first is the honest one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.session import Calibration
from brushloop.calibrate.stroke import PX_PER_MM, Gray, Params
from brushloop.calibrate.stroke.preprocess import Prepared, Steps, prepare, preprocess
from brushloop.calibrate.stroke.rectify import cut_out, on_raster, on_window, rectify_by, rescale
from brushloop.model.ccdbsm import Brush
from brushloop.model.outline import Outline
from brushloop.model.strokes import StrokeModel
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Header

Image = NDArray[np.float32]
Pixels = NDArray[np.uint8]
"""Ink from 0 to 255."""
SIZE_PX = 128
NORMAL_LENGTH_PX = 100
FINE = 4
"""Oversampling: strokes are moved on a raster finer by this factor, near their own 20 px/mm, then area-averaged."""
SPECK_SHARE = 0.002
"""Smallest share of a figure's ink that counts; lower than for a press, because a figure may have dots."""


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
    step_px = (columns[-1] + 1 - columns[0]) / NORMAL_LENGTH_PX
    # Centre without rounding: an offset of half a pixel costs a perfect model several points of SSIM.
    middle = 0.5 * (columns[0] + columns[-1] + 1), 0.5 * (rows[0] + rows[-1] + 1)
    left, top = (float(at - 0.5 * SIZE_PX * step_px) for at in middle)
    return to_tone(averaged(source, (left, top), step_px, SIZE_PX), tone)


def averaged(
    image: NDArray[np.float32], corner_px: tuple[float, float], step_px: float, size_px: int, fine: int = FINE
) -> Image:
    """Average an image over (size_px, size_px) squares of `step_px` each, sampled `fine` times along each side.

    `corner_px` is their upper left corner, x and y.
    """
    scale = fine / step_px
    # cv2 puts pixel centres on integers, here a pixel covers [j, j + 1).
    left, top = (scale * (0.5 - corner) - 0.5 for corner in corner_px)
    move, side = np.array([[scale, 0.0, left], [0.0, scale, top]]), fine * size_px
    return _shrunk(cv2.warpAffine(image, move, (side, side), flags=cv2.INTER_LINEAR), size_px)


def _shrunk(image: cv2.typing.MatLike, size_px: int = SIZE_PX) -> Image:
    return cast("Image", cv2.resize(image, (size_px, size_px), interpolation=cv2.INTER_AREA))


def to_tone(coverage: Image, tone: Tone) -> Image:
    """Coverage unchanged, or 1 where a pixel is mostly ink."""
    return coverage if tone is Tone.GRAY else (coverage > 0.5).astype(np.float32)


def rectified(capture: Capture, calibration: Calibration | None, view: Field) -> tuple[Gray, Steps]:
    """The surroundings of a stroke at 20 px/mm, (h, w) gray, and what was found in them.

    A press is cropped to the field around its zero-touch point, a stroke that travels to its paper cell. A press in an
    imported photograph keeps the surroundings that the light is estimated from; without that point, or of a stroke that
    travels, the photograph is rescaled whole. Raises `CaptureRefused` for a capture that cannot be used,
    `SessionDamaged` for a picture that cannot be read.
    """
    stroke, image, params = capture.stroke, capture.image(), Params() if calibration is None else calibration.params
    if calibration is not None and stroke.anchor_mm is not None:
        window, (left_mm, top_mm) = view.window_mm(stroke.anchor_mm), view.anchor_mm
        if stroke.kind == "drag" and stroke.cell_mm is not None:
            window = x_mm, y_mm, _, tall_mm = stroke.cell_mm
            left_mm, top_mm = stroke.anchor_mm[0] - x_mm, y_mm + tall_mm - stroke.anchor_mm[1]
        raster = rectify_by(image, calibration, window, capture.where)
        cell_px = None if stroke.cell_mm is None else on_window(stroke.cell_mm, window)
        anchor = (left_mm * PX_PER_MM, top_mm * PX_PER_MM)
        return raster, preprocess(raster, anchor, capture.where, params, cell_px)
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has neither a calibration nor a scale of its own")
    anchor_px = stroke.anchor_px
    if anchor_px is not None and stroke.kind == "press":
        around, (left_mm, top_mm) = 0.5 * params.background_mm, view.anchor_mm
        right_mm, bottom_mm = view.side_mm - left_mm, view.side_mm - top_mm
        reach_mm = (left_mm + around, top_mm + around, right_mm + around, bottom_mm + around)
        image, anchor_px = cut_out(image, anchor_px, stroke.px_per_mm, reach_mm, capture.where)
    raster = rescale(image, stroke.px_per_mm, capture.where)
    anchor = None if anchor_px is None else on_raster(anchor_px, stroke.px_per_mm)
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
    return _cropped(steps.prepared, steps.prepared.anchor_px, view)


def _cropped(prepared: Prepared, anchor_px: tuple[float, float], view: Field) -> Prepared:
    """Crop a raster to the field around its anchor; `cut` is set where ink is left out.

    Raises `CaptureRefused` if none of the stroke lies in the field.
    """
    side, (height, width) = round(view.side_mm * PX_PER_MM), prepared.mask.shape
    left, top = (
        min(max(round(at - away_mm * PX_PER_MM), -side), most)
        for at, away_mm, most in zip(anchor_px, view.anchor_mm, (width, height), strict=True)
    )
    window = slice(top + side, top + 2 * side), slice(left + side, left + 2 * side)
    mask, soft = (np.pad(part, side)[window] for part in (prepared.mask, prepared.soft))
    if not mask.any():
        raise CaptureRefused("anchor", "lies so far from the stroke that none of it is in the field")
    cut = prepared.cut or bool(np.count_nonzero(mask) < np.count_nonzero(prepared.mask))
    return replace(prepared, mask=mask, soft=soft, anchor_px=(anchor_px[0] - left, anchor_px[1] - top), cut=cut)


def prepare_cell(capture: Capture, calibration: Calibration) -> Prepared:
    """Rectify a whole paper cell: all ink in it belongs to its figure, however far apart the strokes are.

    Raises `CaptureRefused` for a stroke without a cell, or without ink in it.
    """
    cell_mm = capture.stroke.cell_mm
    if cell_mm is None:
        raise CaptureRefused(capture.stroke.stroke_id, "has no paper cell")
    raster = rectify_by(capture.image(), calibration, cell_mm, capture.where)
    whole = {"join_mm": math.hypot(*cell_mm[2:]), "speck_share": SPECK_SHARE}
    return prepare(raster, None, capture.where, replace(calibration.params, **whole))


def simulated(model: StrokeModel, depth_mm: float, tilt_deg: float, field: Field) -> dict[Key, Image]:
    """Predictions of a press in every alignment and tone, (128, 128) each. May raise `model.ccdbsm.DomainError`.

    The press tilts about the tip, then descends: the brush axis meets the paper H tan(alpha) from the zero-touch point,
    toward the side the ferrule leans to.
    """
    return images_of(model.profile(depth_mm, tilt_deg), depth_mm * math.tan(math.radians(tilt_deg)), field)


def images_of(mark: Outline, origin_x_mm: float, field: Field) -> dict[Key, Image]:
    """A mark in every alignment and tone, (128, 128) each: its exact coverage.

    `origin_x_mm` is the distance of the mark's origin from the zero-touch point.
    """
    left, top = field.anchor_mm
    x_min_mm, x_max_mm = float(mark.x_min_mm[0]), float(mark.x_max_mm[0])
    middle_mm, normal_mm = 0.5 * (x_min_mm + x_max_mm), (x_max_mm - x_min_mm) / NORMAL_LENGTH_PX
    side_mm = SIZE_PX * normal_mm
    views = ((field.mm_per_px, left + origin_x_mm, top), (normal_mm, 0.5 * side_mm - middle_mm, 0.5 * side_mm))
    gray = dict(zip((Alignment.MM, Alignment.SIZE_NORMALISED), draw_loop(mark, views, SIZE_PX), strict=True))
    return {(alignment, tone): to_tone(gray[alignment], tone) for alignment, tone in KEYS}


def levels_of(images: dict[Key, Image]) -> Pixels:
    """Images of every key in 256 levels, (len(KEYS), 128, 128)."""
    return np.stack([to_pixels(images[key]) for key in KEYS])


def draw_loop(loop: Outline, views: Sequence[tuple[float, float, float]], size_px: int) -> NDArray[np.float32]:
    """Exact coverage of a mark in each view, (mm per pixel, x and y of its origin from the upper left corner, mm)."""
    from brushloop.model.raster import kernel  # numba takes a fifth of a second to import

    maps = np.array([[1 / px, 0.0, x / px, 0.0, -1 / px, y / px] for px, x, y in views])
    points, weights = (np.stack([part[0]] * len(maps)) for part in (loop.points, loop.weights))
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
