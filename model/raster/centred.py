"""The compiled rasteriser of centred CCD-BSM marks at heading 0: exact coverage without an outline (numba).

The axis of a mark lies on the middle row edge, so the lower half of the image is the upper one mirrored. Above it, ink
reaches up to the half width w(x). Let P(a) be the ink of one column of pixels up to the level a, the integral of
min(w, a); a pixel holds the difference of P between its row edges. In a column where w does not cross the level,
P(a) = min(m, a), with m the mean half width of the column. So a row of pixels is clamp(m - level, 0, 1). Each level is
crossed once on the tip's side and once on the heel's, at places known in closed form. There P(a) is less, and the two
pixels that meet at the level are corrected by the difference.

In the compiled part everything is in pixels. Means are whole numbers of 2^-23 pixel (coarser in images larger than
128), because float32 rounds half widths of more than 16 pixels by up to 1e-6.
"""

import math

import numba
import numpy as np

from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.raster import PX_MM, SIZE_PX, Images, check_raster
from brushloop.model.raster.kernel import FURTHEST, OPTIONS, compiled, inline


def press_images(mark: CcdBsm, *, size_px: int = SIZE_PX, px_mm: float = PX_MM, out: Images | None = None) -> Images:
    """The covered share of every pixel, (B, size_px, size_px) in [0, 1], for B marks of CCD-BSM at heading 0.

    The same as `coverage` of the mark's outline with its bounding box in the middle, but several times as fast. A
    C-contiguous float32 `out` is filled and returned. Raises ValueError for an odd or invalid size, an invalid `out`,
    and a mark that is not finite or reaches further than a billion pixels.
    """
    check_raster(size_px, px_mm)
    marks = np.stack((mark.o3a_mm, mark.o4o3_mm, mark.half_width_mm, 0.5 * size_px * px_mm - mark.middle_mm), -1)
    wanted = (len(marks), size_px, size_px)
    out = np.empty(wanted, np.float32) if out is None else out
    if size_px % 2 or out.shape != wanted or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out is {out.dtype} {out.shape}, expected C-contiguous float32 {wanted} of an even size")
    means, areas = np.empty(size_px, np.int32), np.zeros(size_px + 2)
    columns = np.empty((2, size_px // 2 + 1), np.int64)
    places, missing = np.empty((2, 2, size_px // 2 + 1))
    if not _draw_all(marks / px_mm, out, means, areas, places, columns, missing):
        raise ValueError(f"a shape is not finite, or lies more than {FURTHEST:g} pixels away")
    return out


@numba.njit(**OPTIONS, cache=True)
def _draw_all(marks, out, means, areas, places, columns, missing):
    """Draw marks (B, 4), in pixels: heel O3A, tip O4O3, half width, and column of O3; false for one out of reach."""
    half = out.shape[1] // 2
    unit = np.int32(1 << min(23, 29 - math.ceil(math.log2(half))))
    for n in range(out.shape[0]):
        heel, tip, wide, cx = marks[n]
        if not abs(heel) + abs(tip) + abs(wide) + abs(cx) < FURTHEST:
            return False
        count = int(min(np.ceil(wide), half))  # rows from the axis to the edge of the mark, or of the image
        flat, blank = out[n].reshape(-1), (half - count) * 2 * half
        flat[:blank] = 0
        flat[len(flat) - blank :] = 0
        _columns(heel, tip, wide, cx, unit, means, areas)
        _rows(out[n], count, unit, means)
        levels = int(min(np.ceil(wide), half + 1))
        _crossings(heel, tip, wide, cx, levels, areas, places, columns, missing)
        _correct(out[n], levels, columns, missing)
        for i in range(half - count, half):
            for j in range(2 * half):
                out[n, 2 * half - 1 - i, j] = out[n, i, j]
    return True


@compiled
def _columns(heel, tip, wide, cx, unit, means, areas):
    """Set the integral of w up to each column edge, and each column's mean in whole units."""
    size = len(means)
    left, right = _clip(np.floor(cx - tip), size), _clip(np.ceil(cx + heel), size)
    middle = min(max(left, int(min(max(np.floor(cx), -1.0), size)) + 1), right + 1)
    half = 2 / 3 * wide * tip
    for j in range(left, middle):
        u = max((j - cx) / tip, -1.0)
        areas[j] = half + wide * tip * (u - u * u * u / 3)
    for j in range(middle, right + 1):
        u = min((j - cx) / heel, 1.0)
        v = math.sqrt((1 - u) * (1 + u))
        areas[j] = half + 0.5 * wide * heel * (u * v + _angle(u, v))
    areas[right + 1] = areas[right]
    means[:left] = 0
    means[right:] = 0
    for j in range(left, right):
        means[j] = np.int32(min(areas[j + 1] - areas[j], size + 1.0) * unit + 0.5)


@inline
def _clip(value, size):
    return int(min(max(0.0, value), float(size)))


@inline
def _rows(image, count, unit, means):
    """Fill the rows above the axis, ignoring crossings of row edges; `_correct` corrects those pixels."""
    half, none, share = image.shape[0] // 2, np.int32(0), np.float32(1.0 / unit)
    for i in range(half - count, half):
        row, level = image[i], np.int32((half - 1.0 - i) * unit + 0.5)
        for j in range(len(row)):
            row[j] = share * np.float32(min(max(np.int32(means[j] - level), none), unit))


@compiled
def _crossings(heel, tip, wide, cx, count, areas, places, columns, missing):
    """Set the columns where w crosses each level on either side, and P(a) - min(m, a) there."""
    size = len(areas) - 2
    half = 2 / 3 * wide * tip
    for k in range(count):  # nothing here depends on `columns` or `areas`: several levels are computed at a time
        v = k / wide
        u, s = math.sqrt(1 - v), math.sqrt((1 - v) * (1 + v))
        places[0, k], places[1, k] = cx - tip * u, cx + heel * s
        missing[0, k] = half - wide * tip * (u - u * u * u / 3)
        missing[1, k] = half + 0.5 * wide * heel * (s * v + _angle(s, v))
    for k in range(count):
        x, y = places[0, k], places[1, k]
        i, j = int(min(max(np.floor(x), -1.0), size)), int(min(max(np.floor(y), -1.0), size))
        p, q = max(i, 0), max(j, 0)
        lack = missing[0, k] - areas[p] - k * (x - i)
        short = areas[q + 1] - missing[1, k] - k * (j + 1 - y)
        both = i == j
        missing[0, k] = lack + (short if both else 0.0) + max(k - areas[p + 1] + areas[p], 0.0)
        missing[1, k] = 0.0 if both else short + max(k - areas[q + 1] + areas[q], 0.0)
        columns[0, k], columns[1, k] = i, j


@inline
def _angle(sine, cosine):
    """The angle, up to a right one, of a sine and a cosine: four times that of a quarter, by its series, to 1e-14."""
    t = sine / (1 + cosine)
    t /= 1 + math.sqrt(1 + t * t)
    q = t * t
    total = 0.0
    for k in range(16, -1, -1):
        total = 1 / (2 * k + 1) - q * total
    return 4 * t * total


@inline
def _correct(image, count, columns, missing):
    """Correct the pixels on both sides of each level, outermost first; nothing is crossed on the axis."""
    half = image.shape[0] // 2
    for k in range(count - 1, -1, -1):
        outer = half - 1 - k
        for side in range(2):
            j = columns[side, k]
            if k and 0 <= j < 2 * half:
                image[outer + 1, j] += np.float32(missing[side, k])
                if outer >= 0:
                    image[outer, j] -= np.float32(missing[side, k])
                    _hold(image, outer, j)
            if outer >= 0 and k + 1 < count and 0 <= columns[side, k + 1] < 2 * half:
                _hold(image, outer, columns[side, k + 1])


@inline
def _hold(image, i, j):
    """Undo rounding beyond 0 and 1."""
    image[i, j] = min(max(image[i, j], np.float32(0.0)), np.float32(1.0))
