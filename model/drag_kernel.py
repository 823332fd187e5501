"""Compiled loops of `model.drag`: how a brush is pulled along its path, signed distances of its
mark, and the normal equations of a fit."""

import math

import numba
import numpy as np

_compile = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
_FAR = 6.0  # distance in edge spreads beyond which a pixel's slope is below 3e-3 of the maximum
_SHORTEST = 0.3  # length of a footprint's stick that is pulled square across, as a share
_STICK = 10  # values of a footprint that belong to its stick, before those of the discs


@_compile
def follow(path, ends, p, out, starts):
    """Fill `out` with the trails of paths (x, y, depth) between `ends`; `p` is `DragModel.vector()`."""
    for i in range(len(ends) - 1):
        first, last, at = ends[i], ends[i + 1] - 1, starts[i]
        x, y, depth = path[first, 0], path[first, 1], path[first, 2]
        ux, uy = 1.0, 0.0
        for k in range(first + 1, last + 1):
            step = math.hypot(path[k, 0] - x, path[k, 1] - y)
            if step > 1e-9:
                ux, uy = (path[k, 0] - x) / step, (path[k, 1] - y) / step
                break
        x += p[10] * ux
        y += p[10] * uy
        for k in range(first, last + 1):
            if k > first:
                dx, dy = path[k, 0] - path[k - 1, 0], path[k, 1] - path[k - 1, 1]
                ds = math.hypot(dx, dy)
                depth += (path[k, 2] - depth) * (1.0 - math.exp(-ds / max(p[5], 0.05)))
                leash = max(p[3] + p[4] * depth, 0.05)
                if ds > 1e-9:
                    # Exact response to a target at constant speed: a steady lag of one leash, plus a decaying term.
                    lag_x, lag_y = leash * dx / ds, leash * dy / ds
                    keep = math.exp(-ds / leash)
                    x = path[k, 0] - lag_x - (path[k - 1, 0] - x - lag_x) * keep
                    y = path[k, 1] - lag_y - (path[k - 1, 1] - y - lag_y) * keep
            n = at + k - first
            out[n, 0] = x + p[6] + p[8] * depth
            out[n, 1] = y + p[7] + p[9] * depth
            out[n, 2] = p[0] + p[1] * depth + p[2] * depth * depth
        n = starts[i + 1] - 1
        out[n, 0] = out[n - 1, 0] + p[11] * (path[last, 0] - x)
        out[n, 1] = out[n - 1, 1] + p[11] * (path[last, 1] - y)
        out[n, 2] = out[n - 1, 2] * p[12]


@_compile
def _quadratic(p, at, depth):
    return p[at] + p[at + 1] * depth + p[at + 2] * depth * depth


@_compile
def pull(path, ends, values, out):
    """Fill `out` with three discs (x, y, half width) for every node of paths of x, y, depth, heading in deg.

    `values` (paths, 28) are those of the footprint that follows each path, in the order of `model.drag.NAMES`.
    """
    for i in range(len(ends) - 1):
        first, last = ends[i], ends[i + 1]
        p = values[i]
        turn = math.radians(path[first, 3])
        depth, travel = path[first, 2], 0.0
        back = _quadratic(p, 3, depth)
        x = path[first, 0] - back * math.cos(turn)
        y = path[first, 1] - back * math.sin(turn)
        for k in range(first, last):
            before, depth, askew = depth, path[k, 2], 0.0
            if depth > before:
                slid = _quadratic(p, 3, depth) - _quadratic(p, 3, before)
                x -= slid * math.cos(turn)
                y -= slid * math.sin(turn)
            dx, dy = path[k, 0] - x, path[k, 1] - y
            far = math.sqrt(dx * dx + dy * dy)
            pulled = far - max(_quadratic(p, 0, depth), 0.05)
            if pulled > 0.0:
                x += pulled * dx / far
                y += pulled * dy / far
                toward = math.atan2(dy, dx)
                askew = (toward - turn + math.pi) % (2.0 * math.pi) - math.pi
                askew *= math.exp(-pulled / max(p[6] + p[7] * depth, 0.05))
                turn = toward - askew
            if k > first:
                travel += math.hypot(path[k, 0] - path[k - 1, 0], path[k, 1] - path[k - 1, 1])
            cos, sin = math.cos(turn), math.sin(turn)
            length = max(_SHORTEST, math.cos(askew))
            for j in range(3):
                ahead = length * _quadratic(p, _STICK + 6 * j, depth)
                out[3 * k + j, 0] = x + cos * ahead - sin * p[8]
                out[3 * k + j, 1] = y + sin * ahead + cos * p[8]
                out[3 * k + j, 2] = _quadratic(p, _STICK + 6 * j + 3, depth) - p[9] * travel


@_compile
def _nearest(nodes, a, b, gx, gy):
    """(signed distance, node, share, unit x, unit y) of the disc that covers a point most deeply."""
    best, node, share, ux, uy = -1e30, a, 0.0, 0.0, 0.0
    for k in range(a, b - 1):
        bx, by = nodes[k + 1, 0] - nodes[k, 0], nodes[k + 1, 1] - nodes[k, 1]
        qx, qy = gx - nodes[k, 0], gy - nodes[k, 1]
        t = min(max((qx * bx + qy * by) / (bx * bx + by * by + 1e-12), 0.0), 1.0)
        dx, dy = qx - t * bx, qy - t * by
        far = math.sqrt(dx * dx + dy * dy)
        value = nodes[k, 2] + t * (nodes[k + 1, 2] - nodes[k, 2]) - far
        if value > best:
            best, node, share = value, k, t
            ux, uy = dx / (far + 1e-9), dy / (far + 1e-9)
    return best, node, share, ux, uy


@_compile
def _circles(nodes, starts):
    """For each trail a circle that contains all its discs, (trails, 3) of x, y, radius.

    No point lies deeper in the trail than in the circle, which is much quicker to compare with.
    """
    out = np.empty((len(starts) - 1, 3))
    for i in range(len(starts) - 1):
        a, b = starts[i], starts[i + 1]
        x, y, radius = np.mean(nodes[a:b, 0]), np.mean(nodes[a:b, 1]), -1e30
        for k in range(a, b):
            radius = max(radius, math.hypot(nodes[k, 0] - x, nodes[k, 1] - y) + nodes[k, 2])
        out[i, 0], out[i, 1], out[i, 2] = x, y, radius + 1e-9
    return out


@_compile
def _nearest_of(nodes, starts, circles, first, last, likely, gx, gy):
    """The same as `_nearest`, over several trails, and which one it is. Quickest if that is the `likely` one.

    Of trails that cover the point equally deeply, the first counts.
    """
    found, which = _nearest(nodes, starts[likely], starts[likely + 1], gx, gy), likely
    for i in range(first, last):
        room = circles[i, 2] - found[0]
        dx, dy = gx - circles[i, 0], gy - circles[i, 1]
        if i == likely or room < 0.0 or dx * dx + dy * dy > room * room:
            continue
        other = _nearest(nodes, starts[i], starts[i + 1], gx, gy)
        if other[0] > found[0] or (other[0] == found[0] and i < which):
            found, which = other, i
    return found, which


@_compile
def signed(nodes, starts, groups, x, y, out):
    """Fill `out` (B, len(y), len(x)) with signed distances, positive in ink; trails `groups[i]` to `groups[i + 1]` make
    image i."""
    circles = _circles(nodes, starts)
    for i in range(len(groups) - 1):
        likely = groups[i]
        for r in range(len(y)):
            for c in range(len(x)):
                found, likely = _nearest_of(nodes, starts, circles, groups[i], groups[i + 1], likely, x[c], y[r])
                out[i, r, c] = found[0]


@_compile
def normal_equations(nodes, starts, groups, slopes, x, y, target, added, spread, square, gradient):
    """Add J'J and J'r of ink minus target over every pixel; returns half the sum of squares.

    `slopes` (nodes, 3, P) are the nodes' derivatives. The position t of the nearest disc is held constant, and so is
    what is `added` to the signed distances, one array for each image or a single one for all of them.
    """
    count = slopes.shape[2]
    j, which = np.empty(count), np.empty(count, np.int64)
    circles = _circles(nodes, starts)
    cost = 0.0
    for i in range(len(groups) - 1):
        likely = groups[i]
        for r in range(len(y)):
            for c in range(len(x)):
                found, likely = _nearest_of(nodes, starts, circles, groups[i], groups[i + 1], likely, x[c], y[r])
                value, k, t, ux, uy = found
                u = (value + added[min(i, len(added) - 1), r, c]) / spread
                seen = 1.0 / (1.0 + math.exp(-min(max(u, -40.0), 40.0)))
                miss = seen - target[i, r, c]
                cost += 0.5 * miss * miss
                if abs(u) > _FAR:
                    continue
                slope = seen * (1.0 - seen) / spread
                used = 0  # most parameters move only other strokes
                for m in range(count):
                    before = slopes[k, 2, m] + ux * slopes[k, 0, m] + uy * slopes[k, 1, m]
                    after = slopes[k + 1, 2, m] + ux * slopes[k + 1, 0, m] + uy * slopes[k + 1, 1, m]
                    change = slope * ((1.0 - t) * before + t * after)
                    if change != 0.0:
                        j[used], which[used] = change, m
                        used += 1
                for m in range(used):
                    gradient[which[m]] += j[m] * miss
                    for n in range(m + 1):
                        square[which[m], which[n]] += j[m] * j[n]
    return cost
