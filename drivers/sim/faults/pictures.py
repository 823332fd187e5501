"""What becomes of the camera's images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NOISE_LEVELS = 6
"""A covered sensor is not quite zero."""


def dark(shape: tuple[int, ...], seed: int) -> NDArray[np.uint8]:
    """An image of this shape from under a lens cap."""
    return np.random.default_rng(seed).integers(0, NOISE_LEVELS, shape, np.uint8)


def retold(jpeg: bytes, number: int) -> bytes:
    """The same picture in other bytes: a JPEG comment with a number, after the two bytes of the start."""
    text = b"%d" % number
    comment = b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text
    return jpeg[:2] + comment + jpeg[2:]


def torn(jpeg: bytes) -> bytes:
    """The first half, with a sound end mark: the rest never arrived."""
    return jpeg[: len(jpeg) // 2] + b"\xff\xd9"
