"""The score of two images of ink: CSIM and SSIM, after the shift that their alignment allows."""

from __future__ import annotations

import itertools
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import Alignment
from brushloop.model.similarity import csim, inked_window, ssim

Image = NDArray[Any]

BEST_SHIFT_PX = 6
"""Most that a size-normalised image is shifted each way."""
_REACH = range(-BEST_SHIFT_PX, BEST_SHIFT_PX + 1)
SHIFTS = np.array(sorted(itertools.product(_REACH, _REACH), key=lambda shift: shift[0] ** 2 + shift[1] ** 2))
"""(n, 2) rows and columns of every shift, the smallest first."""


class Polarity(StrEnum):
    """Whether ink or paper is 1."""

    INK = "ink = 1"
    PAPER = "paper = 1"


def similarity(
    captured: Image, other: Image, alignment: Alignment, polarity: Polarity = Polarity.INK
) -> tuple[float, float]:
    """(CSIM, SSIM) of two (h, w) images of one alignment; if size-normalised, the other is shifted to best overlap.

    Raises ValueError for a blank image.
    """
    if not captured.any() or not other.any():
        raise ValueError("a blank image")
    if alignment is Alignment.SIZE_NORMALISED:
        other = best_shift(other, captured)
    if polarity is Polarity.PAPER:
        captured, other = 1.0 - captured, 1.0 - other
    return csim(captured, other), ssim(captured, other)


def best_shift(moving: Image, fixed: Image) -> Image:
    """Shift `moving` by at most 6 px each way so that its overlap with `fixed` is largest, and of equals the least.

    Overlaps are those of 256 levels, in whole numbers, so that ties are always broken in the same way.
    """
    import scipy.fft  # slow to import, and a collecting rig compares nothing by shift

    reach, window = BEST_SHIFT_PX, inked_window(moving, fixed, BEST_SHIFT_PX)
    a, b = (np.rint(255.0 * image[window]) for image in (fixed, moving))
    size = [scipy.fft.next_fast_len(side + reach, real=True) for side in a.shape]
    overlap = scipy.fft.irfft2(np.conj(scipy.fft.rfft2(a, size)) * scipy.fft.rfft2(b, size), size)
    row, column = SHIFTS[np.rint(overlap[tuple(SHIFTS.T)]).argmax()]
    return np.pad(moving, reach)[reach + row :, reach + column :][: moving.shape[0], : moving.shape[1]]
