"""From conic arcs to pixels, cell by cell: the compiled rasteriser's path for any outline, also outside the image.

Everything is in pixels here: x is the column, y the row, both from the top left corner. A loop that runs
counter-clockwise on the paper descends on its left side, so a descending piece adds the ink to its right and an
ascending piece subtracts it again. Each piece is cut where it crosses pixel edges; the part in one cell adds its
area there and the rest of its height to the next cell, and a running sum along each row turns these
steps into coverage (the accumulation buffer of font rasterisers, with parabolas instead of chords).

Scalars and explicit loops throughout, because they compile to fast code. Measured and rejected: a view of each row
(slower); branches instead of min and max (slower: they are mispredicted).
"""

import math

import numba

from model.raster.octants import OPTIONS, TINY

_ROUGHNESS = 3e-4  # px: longer half axis times angle^4 of a piece stays below this; 6e-7 of a pixel at most (measured)
_ROUNDING = 5e-7  # a running sum this close to 0 or 1 between boundaries is taken as 0 or 1
walked = numba.njit(**OPTIONS)


@walked
def walk_ellipse(out, n, spans, x0, y0, x1, y1, x2, y2, w):
    """Walk an arc of an ellipse as parabolas with the same ends and the same area under them."""
    angle = math.acos(w)
    sine = math.sin(angle)
    mx, my = 0.5 * (x0 + x2), 0.5 * (y0 + y2)
    cx, cy = x1 + (mx - x1) / (sine * sine), y1 + (my - y1) / (sine * sine)
    ex, ey = (mx - cx) / w, (my - cy) / w
    fx, fy = 0.5 * (x2 - x0) / sine, 0.5 * (y2 - y0) / sine
    longer = math.sqrt(max(ex * ex + ey * ey, fx * fx + fy * fy))
    pieces = max(1, math.ceil(2 * angle * (longer / _ROUGHNESS) ** 0.25))
    half = angle / pieces
    c, s = math.cos(half), math.sin(half)
    # On the unit circle: two thirds of the triangle equal the segment, (2 half - sin 2 half) / 2.
    reach = c + 1.5 * (half - s * c) / s
    u, v = w * c + sine * s, w * s - sine * c  # the first piece's middle, at half - angle
    for k in range(pieces):
        xe, ye = x2, y2
        if k < pieces - 1:
            a, b = u * c - v * s, v * c + u * s
            xe, ye = cx + ex * a + fx * b, cy + ey * a + fy * b
        xm, ym = cx + reach * (ex * u + fx * v), cy + reach * (ey * u + fy * v)
        walk_parabola(out, n, spans, x0, y0, xm, ym, xe, ye)
        x0, y0 = xe, ye
        u, v = u * (c * c - s * s) - 2 * v * s * c, v * (c * c - s * s) + 2 * u * s * c


@walked
def walk_parabola(out, n, spans, x0, y0, x1, y1, x2, y2):
    """Walk a quadratic Bezier curve, cut where it turns back in x or y."""
    turns_x, turns_y = (x1 - x0) * (x2 - x1) < 0, (y1 - y0) * (y2 - y1) < 0
    if not turns_x and not turns_y:
        _monotone(out, n, spans, x0, y0, x1, y1, x2, y2)
        return
    a = (x0 - x1) / (x0 - 2 * x1 + x2) if turns_x else 1.0
    b = (y0 - y1) / (y0 - 2 * y1 + y2) if turns_y else 1.0
    low, px, py = 0.0, x0, y0
    for high in (min(a, b), max(a, b), 1.0):
        if high <= low:
            continue
        h, g = 1 - high, 1 - low
        xa, xb, ya, yb = h * x0 + high * x1, h * x1 + high * x2, h * y0 + high * y1, h * y1 + high * y2
        qx, qy = h * xa + high * xb, h * ya + high * yb
        if high == 1.0:
            qx, qy = x2, y2
        # The middle point of a monotone part lies between its ends; clamp it against rounding.
        mx = min(max(g * xa + low * xb, min(px, qx)), max(px, qx))
        my = min(max(g * ya + low * yb, min(py, qy)), max(py, qy))
        _monotone(out, n, spans, px, py, mx, my, qx, qy)
        low, px, py = high, qx, qy


@walked
def _monotone(out, n, spans, x0, y0, x1, y1, x2, y2):
    """Walk a quadratic Bezier curve that is monotone in x and y: row by row downwards, cell by cell in each row."""
    size = out.shape[1]
    sign, side = 1.0, 0
    if y2 < y0:
        x0, y0, x2, y2 = x2, y2, x0, y0
        sign, side = -1.0, 2
    if y2 <= 0.0 or y0 >= size or y0 == y2:
        return
    bx, by = 2 * (x1 - x0), 2 * (y1 - y0)
    ax, ay = x0 - 2 * x1 + x2, y0 - 2 * y1 + y2
    # The integral of x dy between two t is that of the chord plus this times the cube of their difference.
    bulge = sign * (bx * ay - ax * by) / 6
    right = x2 >= x0
    way = 1.0 if right else -1.0
    t, x, y = 0.0, x0, y0
    if y0 < 0.0:
        t = -2 * y0 / (by + math.sqrt(max(0.0, by * by - 4 * ay * y0)) + TINY)
        x, y = x0 + (ax * t + bx) * t, 0.0
    j = math.floor(x)
    for i in range(max(0, math.floor(y0)), min(size, math.ceil(y2))):
        te, xe, ye = 1.0, x2, y2
        if i + 1.0 < y2:
            ye = i + 1.0
            te = 2 * (ye - y0) / (by + math.sqrt(max(0.0, by * by + 4 * ay * (ye - y0))) + TINY)
            xe = x0 + (ax * te + bx) * te
        je = math.floor(xe)
        spans[i, side] = min(spans[i, side], min(j, je))
        spans[i, side + 1] = max(spans[i, side + 1], max(j, je, 0))
        carry = 0.0  # step that the previous cell still adds: to its right neighbour (going right), to itself (left)
        while j != je:
            xc = j + 1.0 if right else float(j)
            tc = 2 * (xc - x0) / (bx + way * (math.sqrt(max(0.0, bx * bx + 4 * ax * (xc - x0))) + TINY))
            yc = min(max(y0 + (ay * tc + by) * tc, y), ye)
            d, drop = tc - t, sign * (yc - y)
            area = 0.5 * (x + xc) * drop + bulge * d * d * d - j * drop  # right of the cell's left edge
            if right:
                _add(out, n, i, j, carry + drop - area)
                carry = area
                j += 1
            else:
                _add(out, n, i, j + 1, carry + area)
                carry = drop - area
                j -= 1
            t, x, y = tc, xc, yc
        d, drop = te - t, sign * (ye - y)
        area = 0.5 * (x + xe) * drop + bulge * d * d * d - j * drop
        if right:
            _add(out, n, i, j, carry + drop - area)
            _add(out, n, i, j + 1, area)
        else:
            _add(out, n, i, j + 1, carry + area)
            _add(out, n, i, j, drop - area)
        t, x, y = te, xe, ye


@walked
def _add(out, n, i, j, step):
    """Add a step of the running sum; a step left of the image is added at its first column."""
    if j < out.shape[2]:
        out[n, i, max(j, 0)] += out.dtype.type(step)


@walked
def sum_rows(out, n, spans):
    """Turn the steps of each row into coverage: cell by cell where pieces passed, as whole runs elsewhere."""
    size = out.shape[1]
    for i in range(size):
        a, b = max(spans[i, 0], 0), min(spans[i, 1] + 2, size)
        c, d = max(spans[i, 2], 0), min(spans[i, 3] + 2, size)
        if c < a:
            a, b, c, d = c, d, a, b
        if a >= b and c >= d:
            continue
        if a >= b:
            a, b, c, d = c, d, size, size
        elif c >= d:
            c = d = size
        elif c < b:
            b, c, d = max(b, d), size, size
        total = 0.0
        for j in range(a, b):
            total += out[n, i, j]
            out[n, i, j] = min(max(total, 0.0), 1.0)
        _fill(out, n, i, b, c, total)
        for j in range(c, d):
            total += out[n, i, j]
            out[n, i, j] = min(max(total, 0.0), 1.0)
        _fill(out, n, i, d, size, total)


@walked
def _fill(out, n, i, start, stop, total):
    """Fill a stretch of a row that no piece crosses."""
    if stop > start and total > _ROUNDING:
        value = out.dtype.type(total if total < 1 - _ROUNDING else 1.0)
        part = out[n, i, start:stop]  # non-negative indices let the compiler use wide stores
        for k in range(len(part)):
            part[k] = value
