"""The compiled rasteriser: from loops of conic arcs to exact area coverage, one image at a time (numba).

A mark inside the image is drawn by `octants` and `rows`, which is several times faster; any other outline is walked
cell by cell (`walk`). Both are exact. Coordinates are float64; the image is float32 or float64.

numba compiles at the first call and caches the machine code.
"""

import zlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

from model.raster.octants import FALLEN, OPTIONS, ellipse, parabola
from model.raster.rows import add_steps, fill_rows, single
from model.raster.walk import sum_rows, walk_ellipse, walk_parabola

_MOST_ARCS = 16  # of an outline drawn by octants: many arcs are short, and each costs as much as twenty pixels
_PAGE = 4096


class Work(NamedTuple):
    """Scratch memory for one image at a time; see `octants` and `rows`."""

    cuts: np.ndarray
    low: np.ndarray
    edge: np.ndarray
    at: np.ndarray
    next: np.ndarray
    here: np.ndarray
    there: np.ndarray
    ends: np.ndarray
    passed: np.ndarray
    parts_at: np.ndarray
    parts_by: np.ndarray
    waiting: np.ndarray
    spans: np.ndarray


def rasterise(points, weights, placed, out):
    """Fill `out` (B, N, N) with the coverage of the loops `points` (B, K, 3, 2) and `weights` (B, K).

    `placed` (B, 6) maps a loop's mm to pixels: column = p0 x + p1 y + p2, row = p3 x + p4 y + p5.
    """
    _rasterise(points, weights, placed, out, _work(out.shape[1], min(points.shape[1], _MOST_ARCS), out.dtype))


def _work(size, arcs, dtype):
    """Allocate `Work` with each array on separate pages: on shared pages the loops take half as long again."""
    layout, room = _layout(size, arcs, dtype)
    raw = np.empty(room + _PAGE, np.uint8)
    start = -raw.ctypes.data % _PAGE
    work = Work(*[np.ndarray(shape, kind, raw, start + at) for shape, kind, at in layout])
    work.passed[:] = work.waiting[:] = 0
    return work


@cache
def _layout(size, arcs, dtype):
    """Shapes, types and offsets of the arrays of `Work`, and their total size in bytes."""
    steps, parts = 5 * arcs * (size + 8), 5 * arcs + 2
    shapes = (
        ((4,), np.float64),
        *(((size + 16,), np.int32),) * 2,
        *(((steps,), np.int32),) * 2,
        *(((steps,), dtype),) * 2,
        *(((2, size), np.int32),) * 2,
        ((size, parts), np.int32),
        ((size, parts), np.float64),
        ((size,), np.int32),
        ((size, 4), np.int64),
    )
    layout, at = [], 0
    for shape, kind in shapes:
        layout.append((shape, kind, at))
        at += -(-np.dtype(kind).itemsize * int(np.prod(shape)) // _PAGE) * _PAGE
    return tuple(layout), at


@numba.njit(**OPTIONS)
def _pixels(q, p):
    """An arc's control points in pixels."""
    x0, y0 = p[0] * q[0, 0] + p[1] * q[0, 1] + p[2], p[3] * q[0, 0] + p[4] * q[0, 1] + p[5]
    x1, y1 = p[0] * q[1, 0] + p[1] * q[1, 1] + p[2], p[3] * q[1, 0] + p[4] * q[1, 1] + p[5]
    x2, y2 = p[0] * q[2, 0] + p[1] * q[2, 1] + p[2], p[3] * q[2, 0] + p[4] * q[2, 1] + p[5]
    return x0, y0, x1, y1, x2, y2


@numba.njit(**OPTIONS)
def _stepped(points, weights, placed, image, work):
    """Draw a mark inside the image; draw nothing and return False if it is not inside or is too tightly bent."""
    size = image.shape[0]
    used = np.int64(0)  # a literal would have another type and compile everything twice
    for k in range(points.shape[0]):
        x0, y0, x1, y1, x2, y2 = _pixels(points[k], placed)
        if weights[k] == 1.0:
            used = parabola(x0, y0, x1, y1, x2, y2, size, work, used)
        else:
            used = ellipse(x0, y0, x1, y1, x2, y2, weights[k], size, work, used)
    if used == FALLEN or not single(size, work):
        work.passed[:] = 0
        work.waiting[:] = 0
        return False
    flat = image.reshape(-1)
    flat[:] = 0
    fill_rows(flat, size, work)
    add_steps(flat, used, work)
    return True


@numba.njit(**OPTIONS)
def _walked(points, weights, placed, out, n, spans):
    size = out.shape[1]
    out[n] = 0
    for i in range(size):
        spans[i, 0] = spans[i, 2] = size
        spans[i, 1] = spans[i, 3] = -2
    for k in range(points.shape[0]):
        x0, y0, x1, y1, x2, y2 = _pixels(points[k], placed)
        if weights[k] == 1.0:
            walk_parabola(out, n, spans, x0, y0, x1, y1, x2, y2)
        else:
            walk_ellipse(out, n, spans, x0, y0, x1, y1, x2, y2, weights[k])
    sum_rows(out, n, spans)


def _sources() -> int:
    """A checksum of all the files that are compiled together."""
    names = ("kernel.py", "octants.py", "rows.py", "walk.py")
    return zlib.crc32(b"".join(Path(__file__).with_name(name).read_bytes() for name in names))


def _compiled(sources):
    """Compile; numba's cache depends on this file's date and on closure values, so `sources` covers the other files."""

    @numba.njit(**OPTIONS, cache=True)
    def rasterise_all(points, weights, placed, out, work):
        arcs = points.shape[1]
        for n in range(out.shape[0] if sources >= 0 else 0):
            if arcs > _MOST_ARCS or not _stepped(points[n], weights[n], placed[n], out[n], work):
                _walked(points[n], weights[n], placed[n], out, n, work.spans)

    return rasterise_all


_rasterise = _compiled(_sources())
