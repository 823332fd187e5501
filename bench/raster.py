"""How fast marks become images: exact coverage, compiled and in torch, beside polygon filling and a memset."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import Result, interleave, machine
from model.ccdbsm import Brush, CcdBsm, ccdbsm
from model.coverage import PX_MM, SIZE_PX, centred_origin, coverage
from model.raster.compiled import coverage_numpy
from model.raster.exact import coverage_at

BATCH = 64
BULK = 1024  # 64 MiB of images: more than a cache holds, as in making a training set
SCALE = 4
POINTS = 64  # along each side of an outline
SHIFT = 4  # fractional bits of fillPoly's fixed-point corners


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Images per second of exact CCD-BSM coverage, 128 x 128, beside cv2.fillPoly at 4x with resize, and a memset.

    ratio = our images/s over the peer's. Presses are drawn from H 11-20 mm, alpha 0-10 deg and any heading. Ours
    counts everything from (H, alpha, heading) to float32 images; fillPoly gets its outlines ready made, is not
    exact (it paints its boundary pixels whole, so its marks come out about 1 % too large, and at 4x it knows 17
    levels of gray). `raster` is torch at heading 0, `raster-any-heading` torch at any, both on one thread like
    their peer. `raster-compiled` and fillPoly run on one thread; `raster-compiled-bulk` and the memset of as many
    bytes on as many threads as there are cores.
    """
    rounds = 40 if n is None else n
    generator = torch.Generator().manual_seed(seed)
    heights_mm, tilts_deg, headings_deg = (
        low + span * torch.rand(BULK, generator=generator) for low, span in ((11, 9), (0, 10), (-180, 360))
    )
    brush, few = Brush(), slice(0, BATCH)
    polygons = outlines(ccdbsm(brush, heights_mm[few], tilts_deg[few], dtype=torch.float64))
    images = np.empty((BULK, SIZE_PX, SIZE_PX), np.float32)
    cores = os.cpu_count() or 1

    def level() -> object:
        mark = ccdbsm(brush, heights_mm[few], tilts_deg[few])
        return coverage(mark, centred_origin(mark))

    def turned() -> object:
        mark = ccdbsm(brush, heights_mm[few], tilts_deg[few])
        return coverage_at(mark, centred_origin(mark), headings_deg[few])

    def compiled(threads: int) -> object:
        mark = ccdbsm(brush, heights_mm, tilts_deg)
        return coverage_numpy(mark, centred_origin(mark), headings_deg, threads=threads, out=images)

    def filled() -> object:
        return [fill(polygon) for polygon in polygons]

    with _one_thread(), ThreadPoolExecutor(cores) as pool:
        per_image = {
            "raster": [s / BATCH for s in interleave(level, filled, rounds)],
            "raster-any-heading": [s / BATCH for s in interleave(turned, filled, rounds)],
        }
        ours_s, peer_s = interleave(lambda: compiled(1), filled, rounds)
        per_image["raster-compiled"] = [ours_s / BULK, peer_s / BATCH]
        ours_s, peer_s = interleave(lambda: compiled(cores), lambda: clear(images, pool, cores), rounds)
        per_image["raster-compiled-bulk"] = [ours_s / BULK, peer_s / BULK]
    fillpoly = f"cv2.fillPoly at {SCALE}x"
    return tuple(
        Result(
            name=name,
            value=1 / ours_s,
            unit="images/s",
            peer=f"memset on {cores} threads" if name.endswith("bulk") else fillpoly,
            ratio=peer_s / ours_s,
            n=rounds,
            seed=seed,
            conditions=machine(),
        )
        for name, (ours_s, peer_s) in per_image.items()
    )


def clear(images: NDArray[np.float32], pool: ThreadPoolExecutor, threads: int) -> None:
    """memset of all the images, an equal share on each thread."""
    share = images.nbytes // threads
    starts = [images.ctypes.data + k * share for k in range(threads)]
    for done in [pool.submit(ctypes.memset, start, 0, share) for start in starts]:
        done.result()


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
