"""A captured press as it is compared: laid on 128 x 128 pixels in every alignment and tone."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.compare.field import KEYS, SIZE_PX, Alignment, Image, captured_mm, captured_normalised
from calibrate.errors import CaptureRefused
from calibrate.stroke.measure import Measured, measure
from calibrate.stroke.preprocess import Prepared

Pixels = NDArray[np.uint8]
"""Ink from 0 to 255."""
MOST_BYTES = 4 * (len(KEYS) + 1) * SIZE_PX**2


@dataclass(frozen=True, slots=True)
class PressImages:
    """A captured press, ready to be compared."""

    measured: Measured
    cut: bool
    flags: tuple[str, ...]
    images: Pixels
    """(len(KEYS), 128, 128)."""
    coverage: Pixels
    """(128, 128) share of each pixel of the millimetre field that is ink: what fits are made of."""


def to_pixels(image: Image) -> Pixels:
    """Ink in [0, 1] on 256 levels, as the camera has it."""
    return np.rint(255.0 * image).astype(np.uint8)


def press_images(stroke_id: str, prepared: Prepared) -> PressImages:
    """Lay a found stroke on pixels for each of `KEYS`. Raises `CaptureRefused` where one would show nothing."""
    images: list[Pixels] = []
    for alignment, tone in KEYS:
        image = to_pixels((captured_mm if alignment is Alignment.MM else captured_normalised)(prepared, tone))
        if not image.any():
            raise CaptureRefused(stroke_id, f"is too thin to be seen at the scale of {alignment} ({tone})")
        images.append(image)
    coverage = cv2.resize(prepared.mask.astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
    return PressImages(
        measure(prepared.mask),
        prepared.cut,
        prepared.flags,
        np.stack(images),
        to_pixels(np.asarray(coverage, np.float32)),
    )


def pack(images: Pixels) -> bytes:
    """(n, 128, 128) images, deflated: most of them is paper."""
    return zlib.compress(np.ascontiguousarray(images).tobytes(), 1)


def unpack(packed: bytes) -> Pixels:
    """(n, 128, 128) images that `pack` made. Raises ValueError for anything else."""
    try:
        inflater = zlib.decompressobj()
        raw = inflater.decompress(packed, 64 * MOST_BYTES)
    except zlib.error as error:
        raise ValueError(f"not packed images: {error}") from None
    if not inflater.eof or len(raw) % SIZE_PX**2:
        raise ValueError("not packed images of 128 x 128 pixels")
    return np.frombuffer(raw, np.uint8).reshape(-1, SIZE_PX, SIZE_PX)
