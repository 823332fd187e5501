"""Images of CCD-BSM's marks at heading 0 straight from presses, compiled: the quickest way to make many."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.raster.compiled import in_parts
from brushloop.model.raster.frame import PX_MM, SIZE_PX, check_raster

Values = float | NDArray[np.floating[Any]]


def press_images(
    brush: Brush,
    depth_mm: Values,
    tilt_deg: Values,
    lam: Values = math.pi,
    *,
    origin_mm: Values | None = None,
    size_px: int = SIZE_PX,
    px_mm: float = PX_MM,
    threads: int | None = None,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """The covered share of every pixel, (B, size_px, size_px) in [0, 1], for CCD-BSM's marks of B presses at heading 0.

    The same as `coverage_numpy(ccdbsm(brush, depth_mm, tilt_deg, lam), origin_mm)`, but several times as fast. Depth,
    tilt, lambda and the lengths of `brush` are broadcast to one (B,). `origin_mm`, (2,) or (B, 2), centres each mark's
    bounding box if it is left out; `threads` and `out` as for `coverage_numpy`, float32 only. Raises DomainError for a
    press outside the model's domain, and ValueError for an invalid size, origin or `out`.
    """
    from brushloop.model.raster.level import draw, lengths

    check_raster(size_px, px_mm)
    columns = (depth_mm, tilt_deg, brush.radius_mm, brush.length_mm, lam)
    presses = np.empty((np.broadcast(*columns).size, len(columns)))
    for k, values in enumerate(columns):
        presses[:, k] = values
    marks = np.empty_like(presses)
    inside = lengths(presses, marks)
    if inside < len(presses):
        height, tilt, radius, length, dilation = presses[inside].tolist()
        ccdbsm(Brush(radius, length), height, tilt, dilation)  # raises a DomainError that names the value
        raise ValueError(f"press {inside}: H = {height:g} mm at {tilt:g} deg makes no mark")
    if origin_mm is not None and np.shape(origin_mm) not in ((2,), (len(marks), 2)):
        raise ValueError(f"origin_mm has shape {np.shape(origin_mm)}, expected (2,) or ({len(marks)}, 2)")
    if origin_mm is None:
        half = 0.5 * size_px * px_mm
        marks[:, 3], marks[:, 4] = half + 0.5 * (marks[:, 1] - marks[:, 0]), half
    else:
        marks[:, 3:] = origin_mm
    marks /= px_mm
    wanted = (len(presses), size_px, size_px)
    if out is None:
        out = np.empty(wanted, np.float32)
    if out.shape != wanted or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out is {out.dtype} {out.shape}, expected C-contiguous float32 {wanted}")
    in_parts(lambda at: draw(marks[at], out[at]), len(out), threads)
    return out
