"""A model's images for the same alignments and tones as the captures."""

from __future__ import annotations

import math

import numpy as np

from calibrate.compare.field import KEYS, NORMAL_LENGTH_PX, SIZE_PX, Alignment, Field, Image, Tone, to_tone
from calibrate.compare.images import Pixels, to_pixels
from model.ccdbsm import Brush
from model.coverage import centred_origin, coverage
from model.outline import Shape
from model.registry import StrokeModel
from sessions.recording.schemas import Header


def brush_of(header: Header) -> Brush:
    """The brush that a recording names; sizes that it does not name are those of the published brush."""
    nominal = Brush()
    return Brush(
        radius_mm=header.brush_radius_mm or nominal.radius_mm, length_mm=header.brush_length_mm or nominal.length_mm
    )


def simulated(
    model: StrokeModel, height_mm: float, tilt_deg: float, alignment: Alignment, tone: Tone, field: Field
) -> Image:
    """(128, 128) prediction of a press. May raise `model.ccdbsm.DomainError`."""
    return to_tone(drawn(model.profile(height_mm, tilt_deg), axis_mm(height_mm, tilt_deg), alignment, field), tone)


def simulated_pixels(model: StrokeModel, height_mm: float, tilt_deg: float, field: Field) -> Pixels:
    """(len(KEYS), 128, 128) predictions of a press. May raise `model.ccdbsm.DomainError`."""
    return shape_pixels(model.profile(height_mm, tilt_deg), axis_mm(height_mm, tilt_deg), field)


def shape_pixels(profile: Shape, origin_x_mm: float, field: Field) -> Pixels:
    """(len(KEYS), 128, 128) of a shape whose origin lies so far from the zero-touch point."""
    gray = {alignment: drawn(profile, origin_x_mm, alignment, field) for alignment in Alignment}
    return np.stack([to_pixels(to_tone(gray[alignment], tone)) for alignment, tone in KEYS])


def axis_mm(height_mm: float, tilt_deg: float) -> float:
    """Where the brush axis meets the paper, from the zero-touch point toward the side that the ferrule leans to.

    The press tilts about the tip, then descends.
    """
    return height_mm * math.tan(math.radians(tilt_deg))


def drawn(profile: Shape, origin_x_mm: float, alignment: Alignment, field: Field) -> Image:
    """(128, 128) coverage by one shape; `origin_x_mm` places it on the millimetre field."""
    if alignment is Alignment.MM:
        left, top = field.anchor_mm
        covered = coverage(profile, (left + origin_x_mm, top), size_px=SIZE_PX, px_mm=field.mm_per_px)
    else:
        length_mm = float(profile.x_max_mm[0] - profile.x_min_mm[0])
        px_mm = length_mm / NORMAL_LENGTH_PX
        origin_mm = centred_origin(profile, size_px=SIZE_PX, px_mm=px_mm)
        covered = coverage(profile, origin_mm, size_px=SIZE_PX, px_mm=px_mm)
    return covered[0].numpy().astype(np.float32)
