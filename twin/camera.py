"""The camera's noise, from stills of one view: what differs between two of them where nothing was drawn."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Recording

STILLS = 8
"""Stills that are compared, each with the next one."""
TO_SD = 1.4826
"""Standard deviation of normally distributed values over their median absolute deviation."""
JPEG_QUALITY = 95
PAPER_GRAY = 215
TRIED = np.arange(0.0, 12.1, 0.5)


def noise_gray(recording: Recording) -> float | None:
    """The noise of a session's camera in gray levels, from its first stills; None for imports, or a single still.

    An import may hold one picture from each of several views.
    """
    if recording.header.source.imported:
        return None
    stills: list[NDArray[np.uint8]] = []
    for capture in recording.captures():
        try:
            stills.append(capture.image())
        except SessionDamaged:
            continue
        if len(stills) == STILLS:
            break
    return noise_of(stills)


def noise_of(stills: Sequence[NDArray[np.uint8]]) -> float | None:
    """Standard deviation in gray levels that the simulated camera needs to be as noisy; None if no two show one view.

    Each pixel's difference between two stills (h, w) has the noise of both; places where ink was added are left out.
    The simulated camera compresses its pictures, which takes away part of the noise: the value is the one that leaves
    as much after compression.
    """
    apart = [_difference(a, b) for a, b in pairwise(stills) if a.shape == b.shape]
    if not apart:
        return None
    left = [_left_after_jpeg(sd) for sd in TRIED]
    return float(np.interp(float(np.median(apart)), left, TRIED))


def _difference(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    moved = a.astype(np.float32) - b.astype(np.float32)
    # a median of whole gray levels is coarse: the mean of what lies within a few levels is not
    near = moved[np.abs(moved) <= max(4.0 * TO_SD * float(np.median(np.abs(moved))), 4.0)]
    return float(near.std()) / np.sqrt(2.0)


def _left_after_jpeg(sd: float) -> float:
    rng = np.random.default_rng(0)
    flat = np.clip(PAPER_GRAY + rng.normal(0.0, sd, (128, 128)), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", flat, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return float(np.std(np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.float64)))
