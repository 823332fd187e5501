"""The compiled loop of `model.footprint`."""

import math

import numba

_compile = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


_SHORTEST = 0.3  # length of a stick that is pulled square across, as a share
_STICK = 10  # values that belong to the stick, before those of the discs


@_compile
def _square(p, at, depth):
    return p[at] + p[at + 1] * depth + p[at + 2] * depth * depth


@_compile
def pull(path, ends, values, out):
    """Fill `out` with three discs (x, y, half width) for every node of paths of x, y, depth, heading in deg.

    `values` (paths, 28) are those of the footprint that follows each path, in the order of `model.footprint.NAMES`.
    """
    for i in range(len(ends) - 1):
        first, last = ends[i], ends[i + 1]
        p = values[i]
        turn = math.radians(path[first, 3])
        depth, travel = path[first, 2], 0.0
        back = _square(p, 3, depth)
        x = path[first, 0] - back * math.cos(turn)
        y = path[first, 1] - back * math.sin(turn)
        for k in range(first, last):
            before, depth, askew = depth, path[k, 2], 0.0
            if depth > before:
                slid = _square(p, 3, depth) - _square(p, 3, before)
                x -= slid * math.cos(turn)
                y -= slid * math.sin(turn)
            dx, dy = path[k, 0] - x, path[k, 1] - y
            far = math.sqrt(dx * dx + dy * dy)
            pulled = far - max(_square(p, 0, depth), 0.05)
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
                ahead = length * _square(p, _STICK + 6 * j, depth)
                out[3 * k + j, 0] = x + cos * ahead - sin * p[8]
                out[3 * k + j, 1] = y + sin * ahead + cos * p[8]
                out[3 * k + j, 2] = _square(p, _STICK + 6 * j + 3, depth) - p[9] * travel
