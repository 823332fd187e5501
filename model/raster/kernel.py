"""The compiled rasteriser: loops of conic arcs to exact area coverage, one image at a time (numba).

Everything is in pixels: x is the column, y the row. Each arc is cut where it turns back in x or y. A piece then
crosses every row edge and every column edge at most once, and each crossing is a root of a quadratic: two loops without
branches, which compile to vector instructions. Between two crossings a piece lies in one cell. Its area there is that
under its chord and a segment, both in closed form. It is added to the cell, the rest of the piece's height to the next
cell, and a running sum along each row turns these steps into coverage (the accumulation buffer of font rasterisers).

A loop that runs counter-clockwise on the paper comes down on its left, so that a piece that comes down adds the ink
on its right, and a piece that goes up removes it. Places are float64; the image is float32 or float64. numba compiles
at the first call and keeps the machine code beside this file.
"""

import math
from typing import Any

import numba
import numpy as np

FURTHEST = 1e9  # px; shapes that reach beyond this, or are not finite, have no integer pixel and are refused
TINY = 1e-300  # keeps 0 / 0 at a tangent from becoming NaN
STRAIGHT = 1e-10  # px^2; a parabola that is flatter has a segment below a tenth of this
ROUNDING = 5e-7  # a running sum this close to 0 or 1 between two boundaries counts as it
# Without reference counts: they are atomic, and cost more than the arithmetic here.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}, "_nrt": False}
compiled = numba.njit(**OPTIONS)
inline = numba.njit(**OPTIONS, forceinline=True)


def rasterise(points, weights, placed, out):
    """Fill `out` (B, N, N) with the coverage of the loops `points` (B, K, 3, 2) and `weights` (B, K).

    `placed` (B, 6) maps a loop's mm to pixels: column = p0 x + p1 y + p2, row = p3 x + p4 y + p5. Raises ValueError
    for a loop that is not finite or lies a billion pixels away.
    """
    size = out.shape[1]
    # Steps of each row, from the cell left of the image on; crossings with row and column edges, the latter one later;
    # and the first and last cell that pieces pass in each row, on their way down and up.
    steps, crossings = np.zeros((size, size + 8)), np.empty((2, size + 3))
    if not _rasterise(points, weights, placed, out, steps, crossings, np.empty((size, 4), np.int64)):
        raise ValueError(f"a shape has points that are not finite or lie more than {FURTHEST:g} pixels away")


@numba.njit(**OPTIONS, cache=True)
def _rasterise(points, weights, placed, out, steps, crossings, spans):
    """Draw one image after another; false for a shape that cannot be drawn."""
    size = out.shape[1]
    for n in range(out.shape[0]):
        for i in range(size):
            spans[i, 0] = spans[i, 2] = size + 1
            spans[i, 1] = spans[i, 3] = -2
        p = placed[n]
        for k in range(points.shape[1]):
            q, w = points[n, k], weights[n, k]
            x0, y0 = p[0] * q[0, 0] + p[1] * q[0, 1] + p[2], p[3] * q[0, 0] + p[4] * q[0, 1] + p[5]
            x1, y1 = p[0] * q[1, 0] + p[1] * q[1, 1] + p[2], p[3] * q[1, 0] + p[4] * q[1, 1] + p[5]
            x2, y2 = p[0] * q[2, 0] + p[1] * q[2, 1] + p[2], p[3] * q[2, 0] + p[4] * q[2, 1] + p[5]
            if not abs(x0) + abs(y0) + abs(x1) + abs(y1) + abs(x2) + abs(y2) < FURTHEST:
                return False
            if w == 1.0:
                _parabola(x0, y0, x1, y1, x2, y2, steps, crossings, spans)
            elif w >= 0.5:
                _ellipse(x0, y0, x1, y1, x2, y2, w, steps, crossings, spans)
            else:  # more than 120 degrees: two halves
                xa, ya, xb, yb = (
                    (x0 + w * x1) / (1 + w),
                    (y0 + w * y1) / (1 + w),
                    (x2 + w * x1) / (1 + w),
                    (y2 + w * y1) / (1 + w),
                )
                xm, ym, half = 0.5 * (xa + xb), 0.5 * (ya + yb), math.sqrt(0.5 * (1 + w))
                _ellipse(x0, y0, xa, ya, xm, ym, half, steps, crossings, spans)
                _ellipse(xm, ym, xb, yb, x2, y2, half, steps, crossings, spans)
        _fill(out, n, steps, spans)
    return True


@compiled
def _parabola(x0, y0, x1, y1, x2, y2, steps, crossings, spans):
    """Add a quadratic Bezier curve."""
    bx, by = 2 * (x1 - x0), 2 * (y1 - y0)
    ax, ay = x0 - 2 * x1 + x2, y0 - 2 * y1 + y2
    turn_x, turn_y = _turn(bx, 2 * ax), _turn(by, 2 * ay)
    # ay x - ax y grows evenly with t, by `bulge`: so the segment between two places needs no t.
    bulge = bx * ay - by * ax
    shape = (ay, -ax, 1 / (6 * bulge * bulge) if abs(bulge) > STRAIGHT else 0.0, 0.0, 0.0, 0.0, 0.0)
    low, px, py = 0.0, x0, y0
    for k in range(3):
        high = min(turn_x, turn_y) if k == 0 else (max(turn_x, turn_y) if k == 1 else 1.0)
        if high <= low:
            continue
        qx, qy = (x0 + (bx + ax * high) * high, y0 + (by + ay * high) * high) if high < 1.0 else (x2, y2)
        if qy >= py:
            xs, ys, xe, ye, dx, dy, sign = px, py, qx, qy, bx + 2 * ax * low, by + 2 * ay * low, 1.0
        else:
            xs, ys, xe, ye, dx, dy, sign = qx, qy, px, py, -bx - 2 * ax * high, -by - 2 * ay * high, -1.0
        low, px, py = high, qx, qy
        if _misses(ys, ye, steps.shape[0]):
            continue
        way = 1.0 if xe >= xs else -1.0
        dx, dy = way * max(0.0, way * dx), max(0.0, dy)
        first, last = _edges(ys, ye, steps.shape[0])
        for i in range(first, last):
            rise = i - ys
            t = 2 * rise / (dy + math.sqrt(max(0.0, dy * dy + 4 * ay * rise)) + TINY)
            crossings[0, i] = xs + (dx + ax * t) * t
        first, last = _edges(min(xs, xe), max(xs, xe), steps.shape[0])
        for j in range(first, last):
            run = j - xs
            t = 2 * run / (dx + way * (math.sqrt(max(0.0, dx * dx + 4 * ax * run)) + TINY))
            crossings[1, j + 1] = ys + (dy + ay * t) * t
        _cells(xs, ys, xe, ye, sign, False, shape, steps, crossings, spans)


@inline
def _turn(slope, bend):
    """Where slope + bend t vanishes within (0, 1), else 1."""
    t = -slope / bend if bend != 0.0 else 1.0
    return t if 0.0 < t < 1.0 else 1.0


@compiled
def _ellipse(x0, y0, x1, y1, x2, y2, w, steps, crossings, spans):
    """Add an arc of an ellipse: C + E cos u + F sin u for |u| <= acos(w) (`model.outline`)."""
    sine = math.sqrt((1 - w) * (1 + w))
    mx, my = 0.5 * (x0 + x2), 0.5 * (y0 + y2)
    cx, cy = x1 + (mx - x1) / (sine * sine), y1 + (my - y1) / (sine * sine)
    ex, ey, fx, fy = (mx - cx) / w, (my - cy) / w, 0.5 * (x2 - x0) / sine, 0.5 * (y2 - y0) / sine
    det, dot = ex * fy - fx * ey, ex * ey + fx * fy
    # At u = x - cx the ellipse lies at y = cy + lean_y u +- high_y sqrt(1 - (u ix)^2); likewise x over y.
    ix, iy = 1 / math.sqrt(ex * ex + fx * fx + TINY), 1 / math.sqrt(ey * ey + fy * fy + TINY)
    lean_y, lean_x, high_y, high_x = dot * ix * ix, dot * iy * iy, abs(det) * ix, abs(det) * iy
    turn_x, turn_y = _extreme(ex * ix, fx * ix, w), _extreme(ey * iy, fy * iy, w)
    shape = (cx, cy, 0.5 * det, 1 / det if det != 0.0 else 0.0, ex * ex + fx * fx, ey * ey + fy * fy, dot)
    low, px, py = -2.0, x0, y0
    for k in range(3):
        s = min(turn_x, turn_y) if k == 0 else (max(turn_x, turn_y) if k == 1 else 1.0)
        if s <= low or (s == 1.0 and k < 2):
            continue
        qx, qy = x2, y2
        if s < 1.0:
            c = math.sqrt((1 - s) * (1 + s))
            qx, qy = cx + c * ex + s * fx, cy + c * ey + s * fy
        xs, ys, xe, ye, sign = (px, py, qx, qy, 1.0) if qy >= py else (qx, qy, px, py, -1.0)
        low, px, py = s, qx, qy
        if _misses(ys, ye, steps.shape[0]):
            continue
        above = high_y if ys + ye - 2 * cy >= lean_y * (xs + xe - 2 * cx) else -high_y
        beside = high_x if xs + xe - 2 * cx >= lean_x * (ys + ye - 2 * cy) else -high_x
        first, last = _edges(ys, ye, steps.shape[0])
        for i in range(first, last):
            v = i - cy
            crossings[0, i] = cx + lean_x * v + beside * math.sqrt(max(0.0, 1 - v * v * iy * iy))
        first, last = _edges(min(xs, xe), max(xs, xe), steps.shape[0])
        for j in range(first, last):
            u = j - cx
            crossings[1, j + 1] = cy + lean_y * u + above * math.sqrt(max(0.0, 1 - u * u * ix * ix))
        _cells(xs, ys, xe, ye, sign, True, shape, steps, crossings, spans)


@inline
def _extreme(c, s, w):
    """The sine of the angle at which a coordinate c cos + s sin is extreme, where the arc reaches it, else 1."""
    if c < 0:
        c, s = -c, -s
    return s if c > w else 1.0


@inline
def _misses(y0, y2, size):
    """Whether a piece that goes down from y0 to y2 meets no row of the image."""
    return y0 == y2 or y2 <= 0.0 or y0 >= size


@inline
def _edges(low, high, size):
    """The edges of the image that lie between two places: the first, and the last + 1."""
    return int(min(max(0.0, np.ceil(low)), size + 1.0)), int(min(max(0.0, np.floor(high) + 1.0), size + 1.0))


@inline
def _cells(x, y, x2, y2, sign, elliptic, shape, steps, crossings, spans):
    """Follow a piece down from cell to cell; what lies beyond the image's sides is in the cells -1 and `size`."""
    size = steps.shape[0]
    right = x2 >= x
    low, high = (x, x2) if right else (x2, x)
    side = 0 if sign > 0 else 2
    if y < 0.0:
        x, y = min(max(crossings[0, 0], low), high), 0.0
    j = int(min(max(np.floor(x), -1.0), size))
    for i in range(int(y), int(min(np.ceil(y2), size))):
        xe, ye = (min(max(crossings[0, i + 1], low), high), i + 1.0) if i + 1.0 < y2 else (x2, y2)
        je = int(min(max(np.floor(xe), -1.0), size))
        spans[i, side] = min(spans[i, side], min(j, je))
        spans[i, side + 1] = max(spans[i, side + 1], max(j, je))
        carry = 0.0  # ink that the previous cell passes on: to the cell on its right (going right), or to itself
        while j != je:
            edge = j + 1 if right else j
            xc, yc = float(edge), min(max(crossings[1, np.uint64(edge + 1)], y), ye)
            drop = sign * (yc - y)
            area = (0.5 * (x + xc) - j) * drop + sign * _segment(x, y, xc, yc, elliptic, shape)
            if right:
                steps[i, np.uint64(j + 1)] += carry + drop - area
                carry = area
                j += 1
            else:
                steps[i, np.uint64(j + 2)] += carry + area
                carry = drop - area
                j -= 1
            x, y = xc, yc
        drop = sign * (ye - y)
        area = (0.5 * (x + xe) - j) * drop + sign * _segment(x, y, xe, ye, elliptic, shape)
        steps[i, np.uint64(j + 1)] += drop - area + (carry if right else 0.0)
        steps[i, np.uint64(j + 2)] += area + (0.0 if right else carry)
        x, y = xe, ye


@inline
def _segment(x0, y0, x2, y2, elliptic, shape):
    """The integral of x dy along a piece less that along its chord.

    A parabola's is a cube (Archimedes); an ellipse's is (angle - sin angle) / 2 times its half axes' product.
    """
    a, b, factor, inverse, xx, yy, xy = shape
    if not elliptic:
        d = a * (x2 - x0) + b * (y2 - y0)
        return factor * d * d * d
    ux, uy, vx, vy = x0 - a, y0 - b, x2 - a, y2 - b
    s = (ux * vy - vx * uy) * inverse
    q = s * s
    if q < 0.01:  # asin(s) - s by its Taylor series
        return factor * s * q * (1 / 6 + q * (3 / 40 + q * (15 / 336 + q * (105 / 3456 + q * (945 / 42240)))))
    cosine = (yy * ux * vx - xy * (ux * vy + vx * uy) + xx * uy * vy) * inverse * inverse
    return factor * (math.atan2(s, cosine) - s)


@compiled
def _fill(out, n, steps, spans):
    """Turn the steps of each row into coverage, and clear them."""
    size = out.shape[1]
    for i in range(size):
        row, image = steps[i], out[n, i]
        first, second = (0, 2) if spans[i, 0] <= spans[i, 2] else (2, 0)
        # Stretches of four cells and more: their number of rounds is easier to predict; further cells have no steps.
        a, c = spans[i, first] + 1, spans[i, second] + 1
        b, d = a + ((spans[i, first + 1] + 6 - a) & -4), c + ((spans[i, second + 1] + 6 - c) & -4)
        if b <= a:
            _run(image, 0, size, 0.0)
            continue
        if c < b or d <= c:
            b = a + ((max(b, d) - a + 3) & -4)
            c = d = size + 4
        _run(image, 0, a - 1, 0.0)
        total = _stretch(row, image, a, b, 0.0)
        _run(image, b - 1, c - 1, total)
        if d > c:
            total = _stretch(row, image, c, d, total)
            _run(image, d - 1, size, total)


@inline
def _stretch(row, image, start, stop, total):
    """Add up the steps of cells that pieces pass; `start` and `stop` count from the cell left of the image."""
    size, zero, one = len(image), image.dtype.type(0.0), image.dtype.type(1.0)
    if start == 0 or stop > size:
        for k in range(start, min(stop, len(row))):
            total += row[k]
            row[k] = 0.0
            if 0 < k <= size:
                image[k - 1] = min(max(image.dtype.type(total), zero), one)
        return total
    for k in range(start, stop, 4):
        for q in range(4):
            total += row[np.uint64(k + q)]
            row[np.uint64(k + q)] = 0.0
            image[np.uint64(k + q - 1)] = min(max(image.dtype.type(total), zero), one)
    return total


@inline
def _run(image, start, stop, total):
    """Fill a stretch of a row that no piece passes."""
    value = image.dtype.type(0.0 if total < ROUNDING else (total if total < 1 - ROUNDING else 1.0))
    start, stop = max(start, 0), min(stop, len(image))
    if stop > start:
        part = image[start:stop]
        for k in range(len(part)):
            part[k] = value
