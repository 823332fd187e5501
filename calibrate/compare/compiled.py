# pyright: basic
"""CSIM and SSIM of one captured image against many predicted ones, compiled (numba).

The numbers are those of `similarity.py` on the images over 255. It is fast because filters and overlaps are computed
only around ink (where both windows are blank SSIM is 1), and because the capture is filtered once for all models. The
best shift is found on whole numbers, so that ties are always broken in the same way.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

RADIUS = 5
"""Radius of the Gaussian window: scikit-image truncates at 3.5 sigma, and ignores a border of this width."""
_X = np.arange(-RADIUS, RADIUS + 1)
_WEIGHTS = np.exp(-0.5 / 1.5**2 * _X**2)
_WEIGHTS /= _WEIGHTS.sum()
_C1, _C2 = 0.01**2, 0.03**2
_compile = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
_reordered = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})


def compare(captured: Pixels, predicted: Pixels, reach: int, out: NDArray[np.float64]) -> None:
    """Fill `out` (M, 2) with CSIM and SSIM of `captured` (h, w) uint8 against `predicted` (M, h, w) uint8.

    Each predicted image is first shifted by at most `reach` px each way, to where the two overlap most. NaN if either
    image is blank.
    """
    _compare(_read_only(captured), _read_only(predicted), reach, out)


def shift_to_overlap(fixed: Pixels, moving: Pixels, reach: int) -> tuple[int, int]:
    """(rows, columns), at most `reach` each, by which `moving` must move back for the largest overlap with `fixed`.

    Both are (h, w) uint8. Equal overlaps, as when one mark lies inside the other, go to the smallest shift, then to
    the first.
    """
    a, b = _read_only(fixed), _read_only(moving)
    return _best_shift(a.astype(np.float32), b.astype(np.float32), _box(a), reach)


def _read_only(pixels: Pixels) -> Pixels:
    """The same pixels in one kind of array: numba would compile everything again for each kind."""
    view = np.ascontiguousarray(pixels).view()
    view.flags.writeable = False
    return view


@_compile
def _compare(captured, predicted, reach, out):
    height, width = captured.shape
    whole = captured.astype(np.float32)
    box = _box(captured)
    x = captured / 255.0
    ux, uxx = np.empty((height, width)), np.empty((height, width))
    uy, uyy, uxy = np.empty((height, width)), np.empty((height, width)), np.empty((height, width))
    scratch = np.empty((height, width))
    everywhere = (RADIUS, height - RADIUS, RADIUS, width - RADIUS)
    _blur(x, everywhere, scratch, ux)
    _blur(x * x, everywhere, scratch, uxx)
    y = np.empty((height, width))
    for m in range(len(predicted)):
        other = _box(predicted[m])
        if box[0] == box[1] or other[0] == other[1]:
            out[m, 0] = out[m, 1] = math.nan
            continue
        dr, dc = _best_shift(whole, predicted[m].astype(np.float32), box, reach)
        y[:] = 0.0
        rows, columns = (max(0, -dr), min(height, height - dr)), (max(0, -dc), min(width, width - dc))
        y[rows[0] : rows[1], columns[0] : columns[1]] = (
            predicted[m, rows[0] + dr : rows[1] + dr, columns[0] + dc : columns[1] + dc] / 255.0
        )
        norm = math.sqrt((x * x).sum()) * math.sqrt((y * y).sum())
        if norm == 0.0:
            out[m, 0] = out[m, 1] = math.nan
            continue
        out[m, 0] = (x * y).sum() / norm
        inked = (
            max(RADIUS, min(box[0], other[0] - dr) - RADIUS),
            min(height - RADIUS, max(box[1], other[1] - dr) + RADIUS),
            max(RADIUS, min(box[2], other[2] - dc) - RADIUS),
            min(width - RADIUS, max(box[3], other[3] - dc) + RADIUS),
        )
        _blur(y, inked, scratch, uy)
        _blur(y * y, inked, scratch, uyy)
        _blur(x * y, inked, scratch, uxy)
        count = (height - 2 * RADIUS) * (width - 2 * RADIUS)
        total = float(count - max(0, inked[1] - inked[0]) * max(0, inked[3] - inked[2]))
        for r in range(inked[0], inked[1]):
            for c in range(inked[2], inked[3]):
                a, b = ux[r, c], uy[r, c]
                va, vb, vab = uxx[r, c] - a * a, uyy[r, c] - b * b, uxy[r, c] - a * b
                total += ((2 * a * b + _C1) * (2 * vab + _C2)) / ((a * a + b * b + _C1) * (va + vb + _C2))
        out[m, 1] = total / count


@_compile
def _box(image):
    """(first row, end row, first column, end column) of what is not 0; all 0 for a blank image."""
    top, bottom, left, right = image.shape[0], 0, image.shape[1], 0
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            if image[r, c]:
                top, bottom = min(top, r), r + 1
                left, right = min(left, c), max(right, c + 1)
    return (top, bottom, left, right) if bottom else (0, 0, 0, 0)


@_reordered
def _best_shift(fixed, moving, box, reach):
    """(dr, dc) for which the sum of fixed[r, c] moving[r + dr, c + dc] is largest.

    Ties, as when one mark lies inside the other, go to the smallest shift, then to the first.
    """
    height, width = fixed.shape
    best, where, least = -1.0, (0, 0), 0
    if reach == 0:
        return where
    for dr in range(-reach, reach + 1):
        for dc in range(-reach, reach + 1):
            total = 0.0
            left, right = max(box[2], -dc), min(box[3], width - dc)
            for r in range(max(box[0], -dr), min(box[1], height - dr)):
                a, b = fixed[r, left:right], moving[r + dr, left + dc : right + dc]
                row = np.float32(0.0)  # exact: whole numbers, at most 128 times 255 x 255
                for k in range(len(a)):
                    row += a[k] * b[k]
                total += row
            far = dr * dr + dc * dc
            if total > best or (total == best and far < least):
                best, where, least = total, (dr, dc), far
    return where


@_compile
def _blur(image, window, scratch, out):
    """Write to `out` the Gaussian mean at each pixel of `window` (first row, end row, first column, end column)."""
    top, bottom, left, right = window
    width = right - left
    w0, w1, w2, w3, w4, w5 = _WEIGHTS[0], _WEIGHTS[1], _WEIGHTS[2], _WEIGHTS[3], _WEIGHTS[4], _WEIGHTS[5]
    for r in range(top - RADIUS, bottom + RADIUS):
        made, s = scratch[r, left:right], image[r, left - RADIUS : right + RADIUS]
        for c in range(width):
            made[c] = (
                w0 * (s[c] + s[c + 10])
                + w1 * (s[c + 1] + s[c + 9])
                + w2 * (s[c + 2] + s[c + 8])
                + w3 * (s[c + 3] + s[c + 7])
                + w4 * (s[c + 4] + s[c + 6])
                + w5 * s[c + 5]
            )
    for r in range(top, bottom):
        made = out[r, left:right]
        for c in range(width):
            made[c] = w5 * scratch[r, left + c]
        for k in range(RADIUS):
            weight, above, below = _WEIGHTS[k], scratch[r + k - RADIUS, left:right], scratch[r - k + RADIUS, left:right]
            for c in range(width):
                made[c] += weight * (above[c] + below[c])
