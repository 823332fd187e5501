"""Compiled sums of the inversion: the moments of images, and the normal equations of outlines against images (numba).

A pixel's coverage changes only where the boundary moves through it, by the flow of the boundary inside the pixel
(Reynolds' transport theorem, as in `model.raster.exact`): dA = integral of (vy dx - vx dy). So a Jacobian has only a
few hundred nonzero rows, which are summed piece by piece without ever making images of derivatives.

Everything is in pixels: x is the column, y the row. Velocities are derivatives of control points by parameter.
"""

import math
from typing import Any

import numba
import numpy as np

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
_compile = numba.njit(**_OPTIONS)
# No reference counting: views of arrays in inner loops would update counts atomically, half of the run time.
_INNER: dict[str, Any] = {**_OPTIONS, "_nrt": False}
_inner = numba.njit(**_INNER)
_GAUSS = 0.5 / math.sqrt(3.0)
_FAINT = 0.25
_SORT_PX = 8.0  # length of the pieces of a parabola: their crossings have to be sorted
_CUT_PX = 3.0  # length of the pieces of an arc of an ellipse, at least eight


@_compile
def moments(images, out):
    """Fill `out` (B, 10) with sums of image x^a y^b about the top left corner, pixel centres at halves.

    Pixels fainter than a quarter count as blank: noise far from the mark would outweigh the mark itself.
    The order is 1, x, y, xx, xy, yy, xxx, xxy, xyy, yyy.
    """
    count, rows, columns = images.shape
    for n in range(count):
        out[n] = 0.0
        for i in range(rows):
            s0 = s1 = s2 = s3 = 0.0
            for j in range(columns):
                value = images[n, i, j]
                if value > _FAINT:
                    x = j + 0.5
                    s0 += value
                    s1 += value * x
                    s2 += value * x * x
                    s3 += value * x * x * x
            y = i + 0.5
            o = out[n]
            o[0] += s0
            o[1] += s1
            o[2] += s0 * y
            o[3] += s2
            o[4] += s1 * y
            o[5] += s0 * y * y
            o[6] += s3
            o[7] += s2 * y
            o[8] += s1 * y * y
            o[9] += s0 * y * y * y


@_compile
def normal_equations(
    points, weights, velocities, rates, predicted, target, block, row, hessian, gradient, cost, meat, cut
):
    """The sums over pixels of J J', J r and r r, and over square blocks of (sum J r)(sum J r)', r = target - predicted.

    points (B, K, 3, 2) and weights (B, K) of loops of conic arcs, velocities (B, P, K, 3, 2) and rates (B, P, K) their
    derivatives; predicted and target (B, N, N); `block` the side of a block in pixels. Image n is compared with
    target[row[n]]. Fills hessian (B, P, P), gradient (B, P), cost (B,), meat (B, P, P); `cut` (B,) is the largest
    share of ink in a pixel on the target's edge.
    """
    size, p_count = predicted.shape[1], velocities.shape[1]
    rows = np.zeros((size * size, p_count))
    touched = np.empty(size * size, np.int64)
    seen = np.zeros(size * size, np.bool_)
    times = np.empty(4 * size + 8)
    across = (size + block - 1) // block
    blocks = np.zeros((across * across, p_count))
    v, on, moved, curve = np.empty((p_count, 3, 2)), np.empty((3, 2)), np.empty((p_count, 3, 2)), np.empty((3, 2))
    _sums(
        points, weights, velocities, rates, predicted, target, block, row, hessian, gradient, cost, meat, cut,
        rows, touched, seen, times, blocks, v, on, moved, curve,
    )  # fmt: skip


@_inner
def _sums(
    points, weights, velocities, rates, predicted, target, block, row, hessian, gradient, cost, meat, cut,
    rows, touched, seen, times, blocks, v, on, moved, curve,
):  # fmt: skip
    """The loop of `normal_equations`, with work space for one image."""
    count, arcs = points.shape[0], points.shape[1]
    size, p_count = predicted.shape[1], velocities.shape[1]
    across = (size + block - 1) // block
    for n in range(count):
        used = 0
        for k in range(arcs):
            q = points[n, k]
            w = weights[n, k]
            if w == 1.0:
                for p in range(p_count):
                    for e in range(3):
                        v[p, e, 0], v[p, e, 1] = velocities[n, p, k, e, 0], velocities[n, p, k, e, 1]
                parts = math.ceil(_length(q) / _SORT_PX) + 1
                for m in range(parts):
                    used = _piece(q, v, m / parts, (m + 1) / parts, size, times, rows, touched, seen, used)
            else:
                used = _conic(
                    q, w, velocities[n, :, k], rates[n, :, k], size, times, rows, touched, seen, used,
                    on, moved, curve, v,
                )  # fmt: skip
        t = target[row[n]]
        edge = 0.0
        for i in range(size):
            edge = max(edge, t[0, i], t[size - 1, i], t[i, 0], t[i, size - 1])
        cost[n], cut[n] = _square_sum(t.reshape(-1), predicted[n].reshape(-1)), edge
        h, g = hessian[n], gradient[n]
        h[:] = 0.0
        g[:] = 0.0
        blocks[:] = 0.0
        for m in range(used):
            at = touched[m]
            i, j = at // size, at % size
            r = float(t[i, j]) - float(predicted[n, i, j])
            part = (i // block) * across + j // block
            for a in range(p_count):
                ja = rows[at, a]
                g[a] += ja * r
                blocks[part, a] += ja * r
                for b in range(a + 1):
                    h[a, b] += ja * rows[at, b]
            rows[at] = 0.0
            seen[at] = False
        for a in range(p_count):
            for b in range(a):
                h[b, a] = h[a, b]
            for b in range(p_count):
                total = 0.0
                for m in range(across * across):
                    total += blocks[m, a] * blocks[m, b]
                meat[n, a, b] = total


@numba.njit(cache=True, nogil=True, fastmath=True)
def _square_sum(a, b):
    """The sum of squared differences, in unspecified order."""
    total = 0.0
    for k in range(len(a)):
        r = float(a[k]) - float(b[k])
        total += r * r
    return total


@_inner
def _conic(q, w, velocity, rate, size, times, rows, touched, seen, used, on, moved, curve, v):
    """Add an arc of an ellipse as parabolas through points at equal angles, with their velocities."""
    p_count = velocity.shape[0]
    half_angle = math.acos(w)
    pieces = max(8, math.ceil(_length(q) / _CUT_PX))
    for piece in range(pieces):
        for end in range(3):
            share = (piece + 0.5 * end) / pieces
            before, after = math.sin(share * half_angle), math.sin((1.0 - share) * half_angle)
            t = before / (before + after)
            b0, b1, b2 = (1.0 - t) ** 2, 2.0 * t * (1.0 - t), t * t
            below = b0 + w * b1 + b2
            for c in range(2):
                on[end, c] = (b0 * q[0, c] + w * b1 * q[1, c] + b2 * q[2, c]) / below
                for p in range(p_count):
                    u = velocity[p]
                    lifted = b0 * u[0, c] + w * b1 * u[1, c] + b2 * u[2, c] + rate[p] * b1 * q[1, c]
                    moved[p, end, c] = (lifted - on[end, c] * rate[p] * b1) / below
        for c in range(2):
            curve[0, c], curve[2, c] = on[0, c], on[2, c]
            curve[1, c] = 2.0 * on[1, c] - 0.5 * (on[0, c] + on[2, c])
            for p in range(p_count):
                m = moved[p]
                v[p, 0, c], v[p, 2, c] = m[0, c], m[2, c]
                v[p, 1, c] = 2.0 * m[1, c] - 0.5 * (m[0, c] + m[2, c])
        used = _piece(curve, v, 0.0, 1.0, size, times, rows, touched, seen, used)
    return used


@_inner
def _length(q):
    """Length of the polygon of an arc's control points."""
    return math.hypot(q[1, 0] - q[0, 0], q[1, 1] - q[0, 1]) + math.hypot(q[2, 0] - q[1, 0], q[2, 1] - q[1, 1])


@_inner
def _sort(part):
    """Sort by insertion: a piece crosses few edges."""
    for k in range(1, len(part)):
        t, m = part[k], k
        while m > 0 and part[m - 1] > t:
            part[m] = part[m - 1]
            m -= 1
        part[m] = t


@_inner
def _piece(q, v, t0, t1, size, times, rows, touched, seen, used):
    """Add the flow of a parabola from t0 to t1 to the rows of the pixels it passes; return how many are touched."""
    x0, y0 = q[0, 0], q[0, 1]
    bx, by = 2.0 * (q[1, 0] - x0), 2.0 * (q[1, 1] - y0)
    ax, ay = x0 - 2.0 * q[1, 0] + q[2, 0], y0 - 2.0 * q[1, 1] + q[2, 1]
    times[0] = t0
    count = _crossings(x0, bx, ax, t0, t1, size, times, 1)
    count = _crossings(y0, by, ay, t0, t1, size, times, count)
    times[count] = t1
    count += 1
    part = times[:count]
    _sort(part)
    for m in range(count - 1):
        low, high = part[m], part[m + 1]
        d = high - low
        if d <= 0.0:
            continue
        middle = 0.5 * (low + high)
        j = math.floor(x0 + (bx + ax * middle) * middle)
        i = math.floor(y0 + (by + ay * middle) * middle)
        if i < 0 or j < 0 or i >= size or j >= size:
            continue
        at = i * size + j
        if not seen[at]:
            seen[at] = True
            touched[used] = at
            used += 1
        # Two-point quadrature integrates the cubic exactly.
        for side in range(2):
            t = middle + (2 * side - 1) * _GAUSS * d
            dx, dy = 0.5 * d * (bx + 2.0 * ax * t), 0.5 * d * (by + 2.0 * ay * t)
            b0, b1, b2 = (1.0 - t) ** 2, 2.0 * t * (1.0 - t), t * t
            for p in range(v.shape[0]):
                u = v[p]
                vx = b0 * u[0, 0] + b1 * u[1, 0] + b2 * u[2, 0]
                vy = b0 * u[0, 1] + b1 * u[1, 1] + b2 * u[2, 1]
                rows[at, p] += vy * dx - vx * dy
    return used


@_inner
def _crossings(start, slope, bend, t0, t1, size, times, count):
    """Store every t in (t0, t1) at which a coordinate crosses a pixel edge of the image in `times`."""
    begin, end = start + (slope + bend * t0) * t0, start + (slope + bend * t1) * t1
    low, high = min(begin, end), max(begin, end)
    if bend != 0.0:
        turn = -0.5 * slope / bend
        if t0 < turn < t1:
            peak = start + 0.5 * slope * turn
            low, high = min(low, peak), max(high, peak)
    for edge in range(max(0, math.ceil(low)), min(size, math.floor(high)) + 1):
        rise = edge - start
        root = math.sqrt(max(0.0, slope * slope + 4.0 * bend * rise))
        both = slope + (root if slope >= 0.0 else -root)  # no cancellation
        if both != 0.0:
            t = 2.0 * rise / both
            if t0 < t < t1:
                times[count] = t
                count += 1
        if bend != 0.0:
            t = -0.5 * both / bend
            if t0 < t < t1:
                times[count] = t
                count += 1
    return count
