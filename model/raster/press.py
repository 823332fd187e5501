"""The compiled rasteriser of CCD-BSM's marks at heading 0: exact coverage without an outline (numba).

Above the axis of a mark, ink reaches up to the half width w(x). Let P(a) be the ink of one column of pixels up to the
level a, the integral of min(w, a); a pixel holds the difference of P between its row edges. In a column where w does
not cross the level, P(a) = min(m, a), with m the mean half width of the column. So a row of pixels is
clamp(m - level, 0, 1). Each level is crossed once on the tip's side and once on the heel's, at places known in closed
form. There P(a) is less, and the two pixels that meet at the level are corrected by the difference. Below the axis all
is mirrored.

In the compiled part everything is in pixels. Means are whole numbers of 2^-23 pixel (coarser in images larger than
128), because float32 rounds half widths of more than 16 pixels by up to 1e-6.
"""

import math

import numba
import numpy as np

from brushloop.model.arrays import Array
from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.raster import PX_MM, SIZE_PX, Images, check_raster
from brushloop.model.raster.kernel import FURTHEST, OPTIONS, compiled, inline

CENTRED = 1e-9  # px; an axis this close to a row edge or to the middle of a row has a mirror image on the grid


def press_images(
    mark: CcdBsm,
    origin_mm: Array | None = None,
    *,
    size_px: int = SIZE_PX,
    px_mm: float = PX_MM,
    out: Images | None = None,
) -> Images:
    """The covered share of every pixel, (B, size_px, size_px) in [0, 1], for B marks of CCD-BSM at heading 0.

    The same as `coverage` of the mark's outline, but several times as fast. `origin_mm`, (2,) or (B, 2), centres each
    mark's bounding box if it is left out. A C-contiguous float32 `out` is filled and returned. Raises ValueError for an
    invalid size, origin or `out`, and for a mark that is not finite or reaches further than a billion pixels.
    """
    check_raster(size_px, px_mm)
    marks = np.empty((len(mark.o3a_mm), 5))
    marks[:, 0], marks[:, 1], marks[:, 2] = mark.o3a_mm, mark.o4o3_mm, mark.half_width_mm
    if origin_mm is None:
        half = 0.5 * size_px * px_mm
        marks[:, 3], marks[:, 4] = half - mark.middle_mm, half
    else:
        marks[:, 3:] = origin_mm
    marks /= px_mm
    wanted = (len(marks), size_px, size_px)
    out = np.empty(wanted, np.float32) if out is None else out
    if out.shape != wanted or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out is {out.dtype} {out.shape}, expected C-contiguous float32 {wanted}")
    means, areas = np.empty(size_px, np.int32), np.zeros(size_px + 2)
    columns = np.empty((2, size_px + 2), np.int64)
    places, missing = np.empty((2, 2, size_px + 2))
    if not _draw_all(marks, out, means, areas, places, columns, missing):
        raise ValueError(f"a shape is not finite, or lies more than {FURTHEST:g} pixels away")
    return out


@numba.njit(**OPTIONS, cache=True)
def _draw_all(marks, out, means, areas, places, columns, missing):
    """Draw marks (B, 5), in pixels: heel O3A, tip O4O3, half width, and column and row of O3.

    False for one that cannot be drawn.
    """
    size = out.shape[1]
    unit = np.int32(1 << min(23, 30 - math.ceil(math.log2(size))))
    for n in range(out.shape[0]):
        heel, tip, wide, cx, cy = marks[n]
        if not abs(heel) + abs(tip) + abs(wide) + abs(cx) + abs(cy) < FURTHEST:
            return False
        twice = np.floor(2 * cy + 0.5)
        mirrored = abs(2 * cy - twice) < CENTRED
        if mirrored:
            cy = 0.5 * twice
        left, right = _clip(np.floor(cx - tip), size), _clip(np.ceil(cx + heel), size)
        top, bottom = _clip(np.floor(cy - wide), size), _clip(np.ceil(cy + wide), size)
        flat = out[n].reshape(-1)
        if right == left or bottom == top:
            flat[:] = 0
            continue
        beyond = np.floor(max(0.0, -cy, cy - size))  # rows from the axis to the image: levels count from there on
        _columns(heel, tip, wide, cx, left, right, beyond, unit, means, areas)
        flat[: top * size] = 0
        flat[bottom * size :] = 0
        copied = mirrored and top + bottom == twice and twice % 2 == 0  # the lower half is the upper one, line by line
        _rows(out[n], cy, beyond, top, (top + bottom) // 2 if copied else bottom, unit, means)
        up, down = np.floor(cy) - beyond, np.ceil(cy) + beyond
        count = _crossings(heel, tip, wide, cx, cy - up, size, areas, places, columns, missing)
        _correct(out[n], cy - up, count, int(up), -1, columns, missing)
        if copied:
            for i in range(top, (top + bottom) // 2):
                for k in range(size):
                    out[n, top + bottom - 1 - i, k] = out[n, i, k]
            continue
        if not mirrored:
            count = _crossings(heel, tip, wide, cx, down - cy, size, areas, places, columns, missing)
        _correct(out[n], down - cy, count, int(down), 1, columns, missing)
    return True


@inline
def _clip(value, size):
    return int(min(max(0.0, value), float(size)))


@compiled
def _columns(heel, tip, wide, cx, left, right, beyond, unit, means, areas):
    """Set the integral of w up to each column edge, and each column's mean beyond a level in whole units."""
    size = len(means)
    middle = min(max(left, int(min(max(np.floor(cx), -1.0), size + 1.0)) + 1), right + 1)
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
        means[j] = np.int32(min(max(areas[j + 1] - areas[j] - beyond, 0.0), size + 1.0) * unit + 0.5)


@inline
def _rows(image, cy, beyond, top, bottom, unit, means):
    """Fill the rows that the mark reaches, ignoring crossings of row edges; `_correct` corrects those pixels."""
    size = image.shape[0]
    zero = np.int32(0)
    share = image.dtype.type(1.0 / unit)
    of = means[:size]
    for i in range(top, bottom):
        part = image[i]
        above = cy - i
        if 0.0 < above < 1.0:
            up, down = np.int32(above * unit + 0.5), np.int32((1 - above) * unit + 0.5)
            for k in range(len(part)):
                part[k] = share * image.dtype.type(np.int32(min(of[k], up) + min(of[k], down)))
        else:
            level = np.int32(((above - 1 if above > 0 else -above) - beyond) * unit + 0.5)
            for k in range(len(part)):
                part[k] = share * image.dtype.type(min(max(np.int32(of[k] - level), zero), unit))


@compiled
def _crossings(heel, tip, wide, cx, start, size, areas, places, columns, missing):
    """Set the columns where w crosses the levels start, start + 1... on either side, and P(a) - min(m, a) there.

    Returns how many levels there are.
    """
    half = 2 / 3 * wide * tip
    count = min(columns.shape[1], int(max(0.0, np.ceil(wide - start))))
    for k in range(count):  # nothing here depends on `columns` or `areas`: several levels are computed at a time
        v = (start + k) / wide
        u, s = math.sqrt(1 - v), math.sqrt((1 - v) * (1 + v))
        places[0, k], places[1, k] = cx - tip * u, cx + heel * s
        missing[0, k] = half - wide * tip * (u - u * u * u / 3)
        missing[1, k] = half + 0.5 * wide * heel * (s * v + _angle(s, v))
    for k in range(count):
        a, x, y = start + k, places[0, k], places[1, k]
        i, j = int(min(max(np.floor(x), -1.0), size)), int(min(max(np.floor(y), -1.0), size))
        p, q = max(i, 0), max(j, 0)
        lack = missing[0, k] - areas[p] - a * (x - i)
        short = areas[q + 1] - missing[1, k] - a * (j + 1 - y)
        both = i == j
        missing[0, k] = lack + (short if both else 0.0) + max(a - areas[p + 1] + areas[p], 0.0)
        missing[1, k] = 0.0 if both else short + max(a - areas[q + 1] + areas[q], 0.0)
        columns[0, k], columns[1, k] = i, j
    return count


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
def _correct(image, start, count, edge, way, columns, missing):
    """Correct the pixels on both sides of each level, outermost first; `edge` is the row edge of the first level."""
    size = image.shape[0]
    inmost = 0 if start > 0.0 else 1  # nothing is crossed on the axis
    for k in range(count - 1, inmost - 2, -1):
        inner = edge + way * k - (1 if way > 0 else 0)
        outer = inner + way
        for side in range(2):
            if k >= inmost:
                j, by = columns[side, k], image.dtype.type(missing[side, k])
                if 0 <= j < size:
                    if 0 <= inner < size:
                        image[inner, j] += by
                    if 0 <= outer < size:
                        image[outer, j] -= by
                        _hold(image, outer, j)
            if k + 1 < count and 0 <= outer < size and 0 <= columns[side, k + 1] < size:
                _hold(image, outer, columns[side, k + 1])


@inline
def _hold(image, i, j):
    """Undo rounding beyond 0 and 1."""
    image[i, j] = min(max(image[i, j], image.dtype.type(0.0)), image.dtype.type(1.0))
