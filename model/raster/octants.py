"""Cut conic arcs into steps: the compiled rasteriser's fast path for marks inside the image (numba).

Everything is in pixels: x is the column, y the row. An arc is cut where it turns back in x or y and where it runs at
45 degrees, so that along each piece one coordinate, u, grows by at least as much as the other, v. A step is the part
between two consecutive integers of u: it passes through at most two pixels and crosses at most one integer of v.
Both crossings are roots of quadratics, so all steps of a piece are one loop without branches, which compiles to
vector instructions. Pieces along which only one coordinate grows are mirrored in y first, so that u and v both grow.
`model.raster.rows` turns steps into pixels.

The area under a step is the area under its chord plus a segment. A parabola's segment is proportional to a cube
(Archimedes); an ellipse's is (angle - sin angle) / 2 times the product of its half axes, with the angle as a short
series in the sine.
"""

import math
from typing import Any

import numba
import numpy as np

TINY = 1e-300  # prevents NaN from 0 / 0 at a tangent
MOST_SINE = 0.35  # largest sine of a step's angle on an ellipse; tighter curves go to `walk`
MOST_SEGMENT = 1e-8  # largest error of a truncated segment series, in pixels
FALLEN = -1  # returned for a mark that this path cannot draw
# No reference counting: it is atomic, and costs twice as much as all computation here.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}, "_nrt": False}
inline = numba.njit(**OPTIONS, forceinline=True)


@inline
def parabola(x0, y0, x1, y1, x2, y2, size, work, used):
    """Add the steps of a quadratic Bezier curve to `work`; return the number of steps so far."""
    cuts = work.cuts
    bx, by = x1 - x0, y1 - y0
    ax, ay = x2 - x1 - bx, y2 - y1 - by
    turns = _turn(bx, ax), _turn(by, ay), _turn(bx - by, ax - ay), _turn(bx + by, ax + ay)
    cuts[0], cuts[1], cuts[2], cuts[3] = _sorted(turns[0], turns[1], turns[2], turns[3])
    low, px, py = 0.0, x0, y0
    for k in range(5):
        high = cuts[k] if k < 4 else 1.0
        if high > low:
            h, g = 1 - high, 1 - low
            xa, xb, ya, yb = h * x0 + high * x1, h * x1 + high * x2, h * y0 + high * y1, h * y1 + high * y2
            qx, qy = h * xa + high * xb, h * ya + high * yb
            if high == 1.0:
                qx, qy = x2, y2
            # The middle point of a monotone part lies between its ends; rounding must not undo that.
            mx = min(max(g * xa + low * xb, min(px, qx)), max(px, qx))
            my = min(max(g * ya + low * yb, min(py, qy)), max(py, qy))
            used = _parabola_piece(px, py, mx, my, qx, qy, size, work, used)
            low, px, py = high, qx, qy
    return used


@inline
def _turn(slope, bend):
    """The t in (0, 1) at which slope + bend t is 0, or else 1."""
    t = -slope / bend if bend != 0.0 else 1.0
    return t if 0.0 < t < 1.0 else 1.0


@inline
def _sorted(a, b, c, d):
    """Sort four numbers without branches, which could be mispredicted."""
    a, b, c, d = min(a, b), max(a, b), min(c, d), max(c, d)
    a, c, b, d = min(a, c), max(a, c), min(b, d), max(b, d)
    return a, min(b, c), max(b, c), d


@inline
def ellipse(x0, y0, x1, y1, x2, y2, w, size, work, used):
    """Add the steps of an arc of an ellipse (`model.outline`); see `parabola`."""
    cuts = work.cuts
    sine2 = (1 - w) * (1 + w)
    mx, my = 0.5 * (x0 + x2), 0.5 * (y0 + y2)
    cx, cy = x1 + (mx - x1) / sine2, y1 + (my - y1) / sine2
    ex, ey = (mx - cx) / w, (my - cy) / w
    fx, fy = 0.5 * (x2 - x0) / math.sqrt(sine2), 0.5 * (y2 - y0) / math.sqrt(sine2)
    cuts[0], cuts[1], cuts[2], cuts[3] = _sorted(
        _extreme(ex, fx, w), _extreme(ey, fy, w), _extreme(ex - ey, fx - fy, w), _extreme(ex + ey, fx + fy, w)
    )
    px, py = x0, y0
    for k in range(5):
        s = cuts[k] if k < 4 else 1.0
        if s < 1.0 or k == 4:
            qx, qy = x2, y2
            if s < 1.0:
                c = math.sqrt((1 - s) * (1 + s))
                qx, qy = cx + c * ex + s * fx, cy + c * ey + s * fy
            used = _ellipse_piece(px, py, qx, qy, cx, cy, ex, ey, fx, fy, size, work, used)
            px, py = qx, qy
    return used


@inline
def _extreme(e, f, w):
    """The sine of the angle at which e cos + f sin is extreme if the arc reaches it, or else 1."""
    r = 1 / math.sqrt(e * e + f * f + TINY)
    c, s = e * r, f * r
    if c < 0:
        c, s = -c, -s
    return s if c > w else 1.0


@inline
def _outside(x0, y0, x2, y2, size):
    return min(min(x0, x2), min(y0, y2)) < 0 or max(max(x0, x2), max(y0, y2)) > size


@inline
def _parabola_piece(x0, y0, x1, y1, x2, y2, size, work, used):
    if used < 0 or _outside(x0, y0, x2, y2, size):
        return FALLEN
    dx, dy = x2 - x0, y2 - y0
    if dx == 0.0 and dy == 0.0:
        return used
    sign = 1.0 if dy > 0 else -1.0
    mirrored = dx * dy < 0
    if dx < 0 or (dx == 0 and dy < 0):
        x0, y0, x2, y2 = x2, y2, x0, y0
    if mirrored:
        y0, y1, y2 = size - y0, size - y1, size - y2
    steep = abs(dy) > abs(dx)
    if steep:
        u0, u1, u2, v0, v1, v2 = y0, y1, y2, x0, x1, x2
    else:
        u0, u1, u2, v0, v1, v2 = x0, x1, x2, y0, y1, y2
    bu, bv, au, av = 2 * (u1 - u0), 2 * (v1 - v0), u0 - 2 * u1 + u2, v0 - 2 * v1 + v2
    first = int(u0)
    count = math.ceil(u2) - first
    start, along, across, beyond = _lattice(first, steep, mirrored, size)
    _parabola_steps(count, first, u0, u2, bu, au, v0, bv, av, steep, size - 1.0, sign, start, along, across, beyond,
                    used, work.low, work.at, work.next, work.here, work.there)  # fmt: skip
    _ends(count, first, u0, u2, v0, v2, sign, mirrored, steep, size, work)
    return used + count


@inline
def _lattice(first, steep, mirrored, size):
    """Index of a piece's pixels in the flat image: start + along step + across v, and the second pixel of a step."""
    down = -size if mirrored else size
    top = (size - 1) * size if mirrored else 0
    if steep:
        return np.int32(top + first * down), np.int32(down), np.int32(1), np.int32(1)
    return np.int32(top + first), np.int32(1), np.int32(down), np.int32(down)


@inline
def _parabola_steps(
    count, first, us, ue, bu, au, vs, bv, av, steep, top, sign, start, along, across, beyond,
    used, low, at, next_, here, there,
):  # fmt: skip
    bulge = (bv * au - av * bu) / 6
    ta, ua, va = 0.0, us, vs
    bu2, bv2, au4, av4 = bu * bu, bv * bv, 4 * au, 4 * av
    for p in range((count + 7) & -8):
        k1 = first + p + 1.0
        ub = min(k1, ue)
        rise = ub - us
        tb = 2 * rise / (bu + math.sqrt(max(0.0, bu2 + au4 * rise)) + TINY)
        vb = vs + (bv + av * tb) * tb
        du = ub - ua
        floor = min(np.floor(va), top)
        v1 = floor + 1.0
        d = tb - ta
        area = 0.5 * (va + vb) * du + bulge * d * d * d
        up = v1 - vs
        tc = min(max(2 * up / (bv + math.sqrt(max(0.0, bv2 + av4 * up)) + TINY), ta), tb)
        uc = us + (bu + au * tc) * tc
        d = tc - ta
        crosses = vb >= v1
        corner = 0.5 * (v1 - va) * min(max(uc - ua, 0.0), du) - bulge * d * d * d
        corner = corner if crosses else v1 * du - area
        if steep:
            near = corner
            far = (v1 + 1.0) * du - area - corner if crosses else du
            far = far if floor < top else 0.0
        else:
            rest = k1 - ub
            far = area - v1 * du + corner + (vb - v1) * rest if crosses else 0.0
            base = max(floor, vs)
            near = area - base * du + (vb - base) * rest - far
        j = np.int32(floor)
        a = start + along * np.int32(p) + across * j
        at[used + p] = a
        next_[used + p] = a + beyond if floor < top else a
        here[used + p] = sign * near
        there[used + p] = sign * far
        low[p] = j
        ta, ua, va = tb, ub, vb


@inline
def _ellipse_piece(x0, y0, x2, y2, cx, cy, ex, ey, fx, fy, size, work, used):
    if used < 0 or _outside(x0, y0, x2, y2, size):
        return FALLEN
    dx, dy = x2 - x0, y2 - y0
    if dx == 0.0 and dy == 0.0:
        return used
    sign = 1.0 if dy > 0 else -1.0
    mirrored = dx * dy < 0
    if dx < 0 or (dx == 0 and dy < 0):
        x0, y0, x2, y2 = x2, y2, x0, y0
    if mirrored:
        y0, y2, cy = size - y0, size - y2, size - cy
        ey, fy = -ey, -fy
    steep = abs(dy) > abs(dx)
    if steep:
        us, ue, vs, ve, cu, cv, eu, ev, fu, fv = y0, y2, x0, x2, cy, cx, ey, ex, fy, fx
    else:
        us, ue, vs, ve, cu, cv, eu, ev, fu, fv = x0, x2, y0, y2, cx, cy, ex, ey, fx, fy
    det, dot = abs(eu * fv - fu * ev), eu * ev + fu * fv
    # On the ellipse u = cu + s / iu and v = cv + lean (u - cu) + high sqrt(1 - s^2); likewise u over v.
    iu, iv = 1 / math.sqrt(eu * eu + fu * fu), 1 / math.sqrt(ev * ev + fv * fv)
    lean, lean_v = dot * iu * iu, dot * iv * iv
    high, high_v = det * iu, det * iv
    if (vs + ve - 2 * cv) < lean * (us + ue - 2 * cu):
        high = -high
    if (us + ue - 2 * cu) < lean_v * (vs + ve - 2 * cv):
        high_v = -high_v
    half = 0.5 * det if high > 0 else -0.5 * det
    s0, s2 = (us - cu) * iu, (ue - cu) * iu
    sine = iu / math.sqrt(max(TINY, 1 - max(s0 * s0, s2 * s2)))
    if not (sine < MOST_SINE and _left_out(det, sine) < MOST_SEGMENT):
        return FALLEN
    first = int(us)
    count = math.ceil(ue) - first
    start, along, across, beyond = _lattice(first, steep, mirrored, size)
    _ellipse_steps(count, first, us, ue, vs, cu, cv, iu, lean, high, half, iv, lean_v, high_v, steep, size - 1.0, sign,
                   start, along, across, beyond, used, work.low, work.at, work.next, work.here, work.there)  # fmt: skip
    _ends(count, first, us, ue, vs, ve, sign, mirrored, steep, size, work)
    return used + count


@inline
def _left_out(det, sine):
    """Upper bound of the truncation error of `_segment`."""
    q = sine * sine
    return 0.01 * det * sine * q * q * q * q * q * q * q


@inline
def _segment(s):
    """asin(s) - s by its Taylor series, |s| <= MOST_SINE."""
    q = s * s
    return s * q * (1 / 6 + q * (3 / 40 + q * (15 / 336 + q * (105 / 3456 + q * (945 / 42240 + q * (10395 / 599040))))))


@inline
def _ellipse_steps(
    count, first, us, ue, vs, cu, cv, iu, lean, high, half, iv, lean_v, high_v, steep, top, sign,
    start, along, across, beyond, used, low, at, next_, here, there,
):  # fmt: skip
    ua, va, sa = us - cu, vs, (us - cu) * iu
    ca = math.sqrt(max(0.0, 1 - sa * sa))
    end = ue - cu
    for p in range((count + 7) & -8):
        k1 = first + p + 1.0 - cu
        ub = min(k1, end)
        sb = ub * iu
        cb = math.sqrt(max(0.0, 1 - sb * sb))
        vb = cv + lean * ub + high * cb
        du = ub - ua
        floor = min(np.floor(va), top)
        v1 = floor + 1.0
        area = 0.5 * (va + vb) * du + half * _segment(sb * ca - sa * cb)
        up = v1 - cv
        s = up * iv
        uc = min(max(lean_v * up + high_v * math.sqrt(max(0.0, 1 - s * s)), ua), ub)
        sc = uc * iu
        cc = math.sqrt(max(0.0, 1 - sc * sc))
        crosses = vb >= v1
        corner = 0.5 * (v1 - va) * (uc - ua) - half * _segment(sc * ca - sa * cc)
        corner = corner if crosses else v1 * du - area
        if steep:
            near = corner
            far = (v1 + 1.0) * du - area - corner if crosses else du
            far = far if floor < top else 0.0
        else:
            rest = k1 - ub
            far = area - v1 * du + corner + (vb - v1) * rest if crosses else 0.0
            base = max(floor, vs)
            near = area - base * du + (vb - base) * rest - far
        j = np.int32(floor)
        a = start + along * np.int32(p) + across * j
        at[used + p] = a
        next_[used + p] = a + beyond if floor < top else a
        here[used + p] = sign * near
        there[used + p] = sign * far
        low[p] = j
        ua, va, sa, ca = ub, vb, sb, cb


@inline
def _ends(count, first, us, ue, vs, ve, sign, mirrored, steep, size, work):
    """Store, for each row that a piece passes, the first of the pixels that lie wholly to its right.

    Rows crossed from edge to edge go to `work.ends`, one list per sign; the first and last go to `work.parts`.
    """
    low = work.low
    ys, ye = (us, ue) if steep else (vs, ve)
    if ye <= ys:
        return
    begin, end = int(ys), math.ceil(ye) - 1
    edge = work.edge
    if steep:
        for p in range(count):
            edge[p] = low[p] + 2
    else:
        # The last column of a row overwrites earlier ones; a row that a step skips takes its predecessor's.
        row = begin
        for p in range(count):
            r = low[p]
            if r > row + 1:
                edge[r - 1 - begin] = first + p
            row = r
            edge[r - begin] = first + p + 1
        edge[end - begin] = first + count
    side = 0 if sign > 0 else 1
    flip = size - 1 if mirrored else 0
    way = -1 if mirrored else 1
    if ys > begin or (end == begin and ye < end + 1):
        _part(flip + way * begin, edge[0], sign * (min(begin + 1.0, ye) - ys), work)
        start = begin + 1
    else:
        start = begin
    stop = end + 1
    if end > begin and ye < end + 1:
        _part(flip + way * end, edge[end - begin], sign * (ye - end), work)
        stop = end
    ends, passed = work.ends[side], work.passed[side]
    row = flip + way * start
    for r in range(start - begin, stop - begin):
        ends[np.uint64(row)] = edge[np.uint64(r)]
        passed[np.uint64(row)] += 1
        row += way


@inline
def _part(row, column, share, work):
    m = work.waiting[row]
    work.parts_at[row, m] = column
    work.parts_by[row, m] = share
    work.waiting[row] = m + 1
