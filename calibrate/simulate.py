"""A model's images for the same alignments and tones as the captures."""

from __future__ import annotations

import math

import numpy as np

from calibrate.field import NORMAL_LENGTH_PX, SIZE_PX, Alignment, Field, Image, Tone, to_tone
from model.coverage import centred_origin, coverage
from model.registry import StrokeModel


def simulated(
    model: StrokeModel, height_mm: float, tilt_deg: float, alignment: Alignment, tone: Tone, field: Field
) -> Image:
    """(128, 128) prediction of a press. May raise `model.ccdbsm.DomainError`.

    On the millimetre field the brush axis meets the paper at H tan(alpha) from the zero-touch point, toward the side
    that the ferrule leans to (the press tilts about the tip, then descends).
    """
    profile = model.profile(height_mm, tilt_deg)
    if alignment is Alignment.MM:
        left, top = field.anchor_mm
        origin = (left + height_mm * math.tan(math.radians(tilt_deg)), top)
        covered = coverage(profile, origin, size_px=SIZE_PX, px_mm=field.mm_per_px)
    else:
        length_mm = float(profile.x_max_mm[0] - profile.x_min_mm[0])
        px_mm = length_mm / NORMAL_LENGTH_PX
        origin_mm = centred_origin(profile, size_px=SIZE_PX, px_mm=px_mm)
        covered = coverage(profile, origin_mm, size_px=SIZE_PX, px_mm=px_mm)
    return to_tone(covered[0].numpy().astype(np.float32), tone)
