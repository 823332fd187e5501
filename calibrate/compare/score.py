"""The score of two images of ink: CSIM and SSIM after the shift that their alignment allows; and the paper's scores."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
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


Triple = tuple[float, float, float]
"""Max, min, avg."""


@dataclass(frozen=True, slots=True)
class Printed:
    """A row of the CCD-BSMG paper's tables, in percent; the paper used its own brush, ink and preprocessing."""

    label: str
    csim: Triple
    ssim: Triple


ROBOT_WRITING = "robot writing"
TABLE_1: dict[str, Printed] = {
    "ccd-bsm": Printed("CCD-BSM", (94.25, 88.33, 91.84), (90.13, 85.16, 87.71)),
    "ccd-bsmg": Printed("CCD-BSMG", (97.29, 89.22, 92.65), (90.58, 85.49, 88.16)),
    ROBOT_WRITING: Printed("robot writing", (98.21, 89.42, 93.31), (95.62, 85.85, 90.12)),
}
"""Generated strokes, and strokes pressed again with the recovered (H, alpha), against real strokes."""
TABLE_2: dict[str, Printed] = {
    "ccd-bsmg": TABLE_1["ccd-bsmg"],
    "ccd-bsm": TABLE_1["ccd-bsm"],
    "bezier": Printed("Bézier", (90.36, 85.48, 88.02), (83.14, 78.21, 81.03)),
    "ellipse": Printed("Ellipse", (86.43, 81.62, 84.15), (76.81, 71.05, 73.46)),
    "circle": Printed("Circle", (71.40, 64.36, 67.03), (63.85, 57.21, 60.23)),
    "line": Printed("Line", (85.99, 81.26, 83.50), (77.38, 67.22, 72.77)),
}
"""Every model against real strokes."""
TABLE_3: dict[str, Printed] = {
    "ccd-bsmg": Printed("CCD-BSMG", (97.71, 91.45, 94.58), (79.26, 72.56, 75.91)),
    ROBOT_WRITING: Printed("robot writing", (95.82, 91.36, 93.59), (78.78, 70.42, 74.60)),
}
"""The character zi. The paper does not say what each row was compared with, nor whether it wrote 字 or 子, nor its
polarity: the pairing of its rows with ours is our interpretation."""
ORDER = ("ccd-bsmg", "ccd-bsm", "bezier", "ellipse", "line", "circle")
"""Models by average CSIM and SSIM, best first, as the paper states it."""
