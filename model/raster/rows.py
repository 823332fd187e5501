"""From steps to pixels: fill rows between the boundaries and sum up the boundary's pixels (see `octants`)."""

import numpy as np

from model.raster.octants import inline

ROUNDING = 5e-7  # a level this close to 0 or 1 is taken as 0 or 1


@inline
def single(size, work):
    """Whether no row is crossed from edge to edge by two pieces of the same sign, as in a shape with a gap."""
    most = 0
    for r in range(size):
        most = max(most, max(work.passed[0, r], work.passed[1, r]))
    return most <= 1


@inline
def fill_rows(flat, size, work):
    """Fill each row of a blank image between the boundaries, and clear the records for the next image."""
    begins, ends = work.ends[0], work.ends[1]
    for r in range(size):
        a, b, m = work.passed[0, r], work.passed[1, r], work.waiting[r]
        if m == 0 and a + b == 2:
            a, b = begins[r], ends[r]
            if a <= b:
                _run(flat, r * size, a, min(b, size), 1.0)
            else:
                _run(flat, r * size, b, min(a, size), -1.0)
        elif m > 0 or a + b > 0:
            _mixed(flat, r, size, work)
        work.passed[0, r] = work.passed[1, r] = work.waiting[r] = 0


@inline
def _mixed(flat, r, size, work):
    """Fill a row in which pieces begin or end."""
    at, by, m = work.parts_at[r], work.parts_by[r], work.waiting[r]
    for side in range(2):
        if work.passed[side, r] == 1:
            at[m], by[m] = work.ends[side, r], 1.0 - 2.0 * side
            m += 1
    for k in range(1, m):
        a, d, q = at[k], by[k], k - 1
        while q >= 0 and at[q] > a:
            at[q + 1], by[q + 1] = at[q], by[q]
            q -= 1
        at[q + 1], by[q + 1] = a, d
    level = 0.0
    for k in range(m - 1):
        level += by[k]
        if abs(level) > ROUNDING:
            _run(flat, r * size, at[k], min(at[k + 1], size), 1.0 if level > 1 - ROUNDING else level)


@inline
def _run(flat, row, start, stop, level):
    """Fill a stretch of a row sixteen pixels at a time; the last sixteen may overlap pixels already filled."""
    value = flat.dtype.type(level)
    n = stop - start
    if n >= 16:
        part = flat[row + start : row + stop]
        for k in range(0, n - 16, 16):
            for q in range(16):
                part[np.uint64(k + q)] = value
        for q in range(16):
            part[np.uint64(n - 16 + q)] = value
    elif n > 0:
        part = flat[row + start : row + stop]
        for k in range(n):
            part[np.uint64(k)] = value


@inline
def add_steps(flat, used, work):
    """Add the steps' areas to their pixels and clamp these to [0, 1]."""
    at, next_, here, there = work.at, work.next, work.here, work.there
    for q in range(used):
        flat[np.uint64(at[q])] += here[q]
        flat[np.uint64(next_[q])] += there[q]
    zero, one = flat.dtype.type(0.0), flat.dtype.type(1.0)
    for q in range(used):
        a, b = np.uint64(at[q]), np.uint64(next_[q])
        flat[a] = min(max(flat[a], zero), one)
        flat[b] = min(max(flat[b], zero), one)
