"""The compiled loop of `model.footprint`."""

import math

import numba

_compile = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


@_compile
def pull(path, ends, values, out):
    """Fill `out` with three discs (x, y, half width) for every node of paths of x, y, depth, heading in deg.

    `values` (paths, 23) are those of the footprint that follows each path.
    """
    for i in range(len(ends) - 1):
        first, last = ends[i], ends[i + 1]
        p = values[i]
        turn = math.radians(path[first, 3])
        for j in range(3):
            q = p[7 * j : 7 * j + 7]
            back = q[2] + q[3] * path[first, 2]
            x = path[first, 0] - back * math.cos(turn)
            y = path[first, 1] - back * math.sin(turn)
            ux, uy = math.cos(turn), math.sin(turn)
            for k in range(first, last):
                depth = path[k, 2]
                if k > first and depth > path[k - 1, 2]:
                    slid = q[3] * (depth - path[k - 1, 2])
                    x -= slid * ux
                    y -= slid * uy
                leash = max(q[0] + q[1] * depth, 0.05)
                dx, dy = path[k, 0] - x, path[k, 1] - y
                far = math.sqrt(dx * dx + dy * dy)
                if far > leash:
                    ux, uy = dx / far, dy / far
                    x += (far - leash) * ux
                    y += (far - leash) * uy
                cos, sin = math.cos(math.radians(path[k, 3])), math.sin(math.radians(path[k, 3]))
                out[3 * k + j, 0] = x + cos * p[21] - sin * p[22]
                out[3 * k + j, 1] = y + sin * p[21] + cos * p[22]
                out[3 * k + j, 2] = q[4] + q[5] * depth + q[6] * depth * depth
