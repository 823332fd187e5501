"""A captured press as the images that are compared, in each alignment and tone."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from calibrate.compare.field import Alignment, Image, Tone, best_shift, captured_mm, captured_normalised
from calibrate.compare.similarity import csim, ssim
from calibrate.errors import CaptureRefused
from calibrate.stroke.measure import Measured, measure
from calibrate.stroke.preprocess import Prepared

Key = tuple[Alignment, Tone]
KEYS: tuple[Key, ...] = tuple(itertools.product(Alignment, Tone))


@dataclass(frozen=True, slots=True)
class Seen:
    """A press as it was captured; depth and tilt as commanded."""

    stroke_id: str
    height_mm: float
    tilt_deg: float
    measured: Measured
    images: dict[Key, Image]
    """(128, 128) each."""


def seen(stroke_id: str, height_mm: float, tilt_deg: float, prepared: Prepared) -> Seen:
    """Of a capture on the millimetre field. Raises `CaptureRefused` where one of the images would be blank."""
    images = {
        (alignment, tone): (captured_mm if alignment is Alignment.MM else captured_normalised)(prepared, tone)
        for alignment, tone in KEYS
    }
    for (alignment, tone), image in images.items():
        if not image.any():
            raise CaptureRefused(stroke_id, f"is too thin to be seen at the scale of {alignment} ({tone})")
    return Seen(stroke_id, height_mm, tilt_deg, measure(prepared.mask), images)


def similarity(captured: Image, other: Image, alignment: Alignment) -> tuple[float, float]:
    """(CSIM, SSIM) of two (128, 128) images of one alignment, after the best shift where it asks for one."""
    if alignment is Alignment.SIZE_NORMALISED:
        other = best_shift(other, captured)
    return csim(captured, other), ssim(captured, other)
