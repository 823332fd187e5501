"""How fast marks become images: exact coverage beside polygon filling with supersampling."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import Result, interleave
from model.ccdbsm import Brush, CcdBsm, ccdbsm
from model.coverage import PX_MM, SIZE_PX, centred_origin, coverage

BATCH = 64
SCALE = 4
POINTS = 64  # along each side of an outline
SHIFT = 4  # fractional bits of fillPoly's fixed-point corners


def run(*, n: int | None = None, seed: int = 0) -> Result:
    """Images per second of exact CCD-BSM coverage (batch 64, 128 x 128) beside cv2.fillPoly at 4x with
    resize.

    ratio = our images/s over the peer's. Presses are drawn from H 11-20 mm and alpha 0-10 deg. Ours counts
    everything from (H, alpha) to the images, in float32 (error below 1e-3); the peer gets its outlines ready
    made. fillPoly is not exact: it paints its boundary pixels whole, so its marks come out about 1 % too
    large, and at 4x it knows 17 levels of gray. Both run on one thread.
    """
    rounds = 40 if n is None else n
    generator = torch.Generator().manual_seed(seed)
    heights_mm = 11 + 9 * torch.rand(BATCH, generator=generator)
    tilts_deg = 10 * torch.rand(BATCH, generator=generator)
    brush = Brush()

    def exact() -> torch.Tensor:
        mark = ccdbsm(brush, heights_mm, tilts_deg)
        return coverage(mark, centred_origin(mark))

    polygons = outlines(ccdbsm(brush, heights_mm, tilts_deg, dtype=torch.float64))
    with _one_thread():
        ours_s, peer_s = interleave(exact, lambda: [fill(polygon) for polygon in polygons], rounds)
    return Result(
        name="raster",
        value=BATCH / ours_s,
        unit="images/s",
        peer=f"cv2.fillPoly at {SCALE}x",
        ratio=peer_s / ours_s,
        n=rounds,
        seed=seed,
    )


def outlines(mark: CcdBsm) -> NDArray[np.int32]:
    """The marks as polygons in fillPoly's fixed-point pixels at 4x, (B, 2 POINTS, 2)."""
    # Points crowd at both ends, where the outline turns fastest.
    share = 0.5 - 0.5 * torch.cos(torch.linspace(0, torch.pi, POINTS, dtype=torch.float64))
    x = mark.x_min_mm[:, None] + share * mark.length_mm[:, None]
    w = mark.half_width(x)
    upper, lower = torch.stack((x, -w), dim=-1), torch.stack((x, w), dim=-1).flip(1)
    points_mm = torch.cat((upper, lower), dim=1) + centred_origin(mark)[:, None, :]
    # fillPoly counts from pixel centres, images from pixel edges.
    return ((points_mm * (SCALE / PX_MM) - 0.5) * 2**SHIFT).round().to(torch.int32).numpy()


def fill(polygon: NDArray[np.int32]) -> NDArray[np.uint8]:
    """One polygon filled at 4x and averaged down to 128 x 128, 0-255."""
    canvas = np.zeros((SCALE * SIZE_PX, SCALE * SIZE_PX), np.uint8)
    cv2.fillPoly(canvas, [polygon], 255, shift=SHIFT)
    return cv2.resize(canvas, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Hold torch and OpenCV to one thread each, and restore what was set before."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])
