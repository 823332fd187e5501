"""How much of the picture differs from another: enough to tell an arm, a hand or another sheet from a new stroke."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from collect.photograph.ink import gray

Thumbnail = NDArray[np.float32]
WIDTH_PX = 160
"""A pixel then averages over some 2 mm of a sheet: noise is gone, and an arm is tens of pixels wide."""
CHANGED_LEVELS = 25.0
"""Gray levels, the light taken out, from which a pixel counts as changed."""


def thumbnail(image: NDArray[np.uint8]) -> Thumbnail:
    """(h, 160) gray levels of an (h, w) or (h, w, 3) BGR frame."""
    height, width = image.shape[:2]
    size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
    return gray(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)).astype(np.float32)


def changed_share(now: Thumbnail, before: Thumbnail) -> float:
    """Share of the pixels that differ, 0 to 1, whatever the light does as a whole; 1 for frames of another size."""
    if now.shape != before.shape:
        return 1.0
    light = float(np.median((now + 1.0) / (before + 1.0)))
    return float(np.mean(np.abs(now - light * before) > CHANGED_LEVELS))
