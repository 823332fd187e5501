"""Exact coverage on the CPU with compiled loops: for images in bulk, where no gradient is needed.

Needs numba, which is imported at the first call; that call also compiles for some seconds, once per machine, as
numba caches the machine code next to the source or in its cache folder.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brushloop.model.outline import Shape
from brushloop.model.raster.frame import PX_MM, SIZE_PX, Place, check_raster, to_pixels

_PER_THREAD = 64  # images; fewer are not worth a thread
Images = NDArray[np.floating[Any]]


def coverage_numpy(
    shape: Shape,
    origin_mm: Place,
    heading_deg: float | Tensor = 0.0,
    *,
    size_px: int = SIZE_PX,
    px_mm: float = PX_MM,
    threads: int | None = None,
    out: Images | None = None,
) -> Images:
    """The covered share of every pixel, (B, size_px, size_px) in [0, 1], for B shapes; arguments as for `coverage_at`.

    float32 unless `out` is given: a C-contiguous float32 or float64 array of that shape, which is filled and
    returned. `threads` defaults to the number of cores for large batches and 1 for small ones. The error stays below
    1e-6. Raises ValueError for an invalid size, shape or `out`, and for a shape that is not finite.
    """
    from brushloop.model.raster.kernel import rasterise  # numba takes a fifth of a second to import

    check_raster(size_px, px_mm)
    outline = shape.outline()
    placed = to_pixels(origin_mm, heading_deg, px_mm, outline.weights.detach().double())
    points, weights, maps = (_array(tensor) for tensor in (outline.points, outline.weights, placed))
    wanted = (len(outline.points), size_px, size_px)
    if out is None:
        out = np.empty(wanted, np.float32)
    if out.shape != wanted or out.dtype.char not in "fd" or not out.flags.c_contiguous:
        raise ValueError(f"out is {out.dtype} {out.shape}, expected C-contiguous float32 or float64 {wanted}")
    in_parts(lambda at: rasterise(points[at], weights[at], maps[at], out[at]), len(out), threads)
    return out


def in_parts(work: Callable[[slice], None], count: int, threads: int | None) -> None:
    """Do the work on all of `count` images, an equal share on each thread where there are enough."""
    parts = min(threads or os.cpu_count() or 1, max(1, count // _PER_THREAD))
    if parts == 1:
        work(slice(0, count))
        return
    # The loops release the interpreter's lock, so plain threads run in parallel.
    with ThreadPoolExecutor(parts) as pool:
        for done in [pool.submit(work, slice(k * count // parts, (k + 1) * count // parts)) for k in range(parts)]:
            done.result()


def _array(tensor: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(tensor.detach().to("cpu", torch.float64).numpy())
