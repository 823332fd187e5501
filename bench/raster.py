"""How fast marks become images: exact coverage, compiled and in torch, beside polygon filling and a memset."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.harness import Result, interleave, machine
from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import CcdBsm, ccdbsm
from brushloop.model.press_images import press_images
from brushloop.model.raster.compiled import coverage_numpy
from brushloop.model.raster.exact import coverage_at
from brushloop.model.raster.frame import PX_MM, SIZE_PX, centred_origin, to_pixels

BATCH = 64
BULK = 1024  # 64 MiB of images: more than a cache holds, as in making a training set
SCALE = 4
POINTS = 64  # along each side of an outline
SHIFT = 4  # fractional bits of fillPoly's fixed-point corners
Work = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Presses:
    """What is drawn: presses at any heading, each in the middle of its image."""

    depth_mm: Tensor
    tilt_deg: Tensor
    heading_deg: Tensor

    def mark(self, count: int) -> CcdBsm:
        """The first `count` marks."""
        return ccdbsm(Brush(), self.depth_mm[:count], self.tilt_deg[:count])

    def origin(self, mark: CcdBsm) -> Tensor:
        """The `origin_mm` that puts the marks' middles in the middle of the image, (B, 2)."""
        middle = 0.5 * (mark.x_min_mm + mark.x_max_mm)
        turn = torch.deg2rad(self.heading_deg[: len(middle)])
        half = 0.5 * SIZE_PX * PX_MM
        return torch.stack((half - middle * torch.cos(turn), half + middle * torch.sin(turn)), dim=-1)


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Images per second of exact CCD-BSM coverage, 128 x 128, beside cv2.fillPoly at 4x with resize, and a memset.

    ratio = our images/s over the peer's. Presses are drawn from H 11-20 mm, alpha 0-10 deg and any heading, each in the
    middle of its image; both sides draw the same ones, `raster-press` at heading 0. Ours counts everything from
    (H, alpha, heading) to float32 images; fillPoly gets its outlines ready made and gives 8-bit images, is not
    exact (it paints its boundary pixels whole, so its marks come out about 1 % too large, and at 4x it knows 17
    levels of gray), and each of its images is a zeroed canvas, a fill and an area mean. The memset clears the same
    images. `raster-any-heading` is torch, 64 images a call on one thread.
    `raster-press` is the compiled path from (H, alpha) and `raster-compiled` that from any outline, at any heading: 64
    images a call on one thread, or, as `-bulk`, 1024 on as many threads as there are cores, as do their peers.
    The images of the compiled rows are written into memory that is used again.
    Times are CPU seconds of all threads, and means of the quickest tenth of the rounds: other work on the machine
    only ever slows.
    """
    rounds = 60 if n is None else n
    generator = torch.Generator().manual_seed(seed)
    drawn = Presses(
        *(low + span * torch.rand(BULK, generator=generator) for low, span in ((11, 9), (0, 10), (-180, 360)))
    )
    images = np.empty((BULK, SIZE_PX, SIZE_PX), np.float32)
    cores, brush = os.cpu_count() or 1, Brush()
    depth_mm, tilt_deg = (values.double().numpy() for values in (drawn.depth_mm, drawn.tilt_deg))
    level_polygons = outlines(drawn.mark(BATCH))
    polygons = outlines(drawn.mark(BATCH), drawn.origin(drawn.mark(BATCH)), drawn.heading_deg[:BATCH])

    def turned() -> object:
        mark = drawn.mark(BATCH)
        return coverage_at(mark, drawn.origin(mark), drawn.heading_deg[:BATCH])

    def presses(count: int, threads: int) -> object:
        return press_images(brush, depth_mm[:count], tilt_deg[:count], threads=threads, out=images[:count])

    def compiled(count: int, threads: int) -> object:
        mark = drawn.mark(count)
        heading_deg = drawn.heading_deg[:count]
        return coverage_numpy(mark, drawn.origin(mark), heading_deg, threads=threads, out=images[:count])

    def filled(which: NDArray[np.int32]) -> object:
        return [fill(polygon) for polygon in which]

    with _one_thread(), ThreadPoolExecutor(cores) as pool:

        def shared(which: NDArray[np.int32]) -> object:
            return [done.result() for done in [pool.submit(filled, part) for part in np.array_split(which, cores)]]

        def cleared(count: int, threads: int) -> object:
            return clear(images[:count], pool, threads)

        few, many = (BATCH, 1), (BULK, cores)
        one, all_ = "cv2.fillPoly at 4x", f"cv2.fillPoly at 4x on {cores} threads"
        contests: tuple[tuple[str, Work, int, Work, int, str], ...] = (
            ("raster-press", _many(lambda: presses(*few)), BULK, lambda: filled(level_polygons), BATCH, one),
            ("raster-press-memset", _many(lambda: presses(*few)), BULK, lambda: cleared(*few), BATCH, "memset"),
            ("raster-press-bulk", lambda: presses(*many), BULK, lambda: shared(level_polygons), BATCH, all_),
            ("raster-press-bulk-memset", lambda: presses(*many), BULK, lambda: cleared(*many), BULK,
             f"memset on {cores} threads"),
            ("raster-any-heading", turned, BATCH, lambda: filled(polygons), BATCH, one),
            ("raster-compiled", _many(lambda: compiled(*few)), BULK, lambda: filled(polygons), BATCH, one),
            ("raster-compiled-bulk", lambda: compiled(*many), BULK, lambda: shared(polygons), BATCH, all_),
            ("raster-compiled-bulk-memset", lambda: compiled(*many), BULK, lambda: cleared(*many), BULK,
             f"memset on {cores} threads"),
        )  # fmt: skip
        results: list[Result] = []
        for name, ours, count, peer, peers, of in contests:
            turns = interleave(ours, peer, rounds, time.process_time)
            # Of all threads' seconds: on two threads a second has two of them.
            ours_s, peer_s = turns.quickest_s[0] / count, turns.quickest_s[1] / peers
            both = turns.ratios(count / peers)
            results.append(Result(name, 1 / ours_s, "images/s", of, peer_s / ours_s, rounds, seed, machine(), **both))
        return results


def _many(work: Work) -> Work:
    """Draw BULK images in calls of BATCH; a single short call would mostly measure caches that the peer has emptied."""

    def repeated() -> None:
        for _ in range(BULK // BATCH):
            work()

    return repeated


def clear(images: NDArray[np.float32], pool: ThreadPoolExecutor, threads: int) -> None:
    """memset of all the images, an equal share on each thread."""
    if threads == 1:
        ctypes.memset(images.ctypes.data, 0, images.nbytes)
        return
    share = images.nbytes // threads
    starts = [images.ctypes.data + k * share for k in range(threads)]
    for done in [pool.submit(ctypes.memset, start, 0, share) for start in starts]:
        done.result()


def outlines(mark: CcdBsm, origin_mm: Tensor | None = None, heading_deg: float | Tensor = 0.0) -> NDArray[np.int32]:
    """The marks as polygons in fillPoly's fixed-point pixels at 4x, (B, 2 POINTS, 2)."""
    # Points crowd at both ends, where the outline turns fastest.
    share = 0.5 - 0.5 * torch.cos(torch.linspace(0, torch.pi, POINTS))
    x = mark.x_min_mm[:, None] + share * mark.length_mm[:, None]
    w = mark.half_width(x)
    x, y = torch.cat((x, x.flip(1)), dim=1), torch.cat((w, -w.flip(1)), dim=1)
    origin = centred_origin(mark) if origin_mm is None else origin_mm
    m = to_pixels(origin, heading_deg, PX_MM / SCALE, x)[:, :, None].unbind(1)
    points = torch.stack((m[0] * x + m[1] * y + m[2], m[3] * x + m[4] * y + m[5]), dim=-1)
    # fillPoly counts from pixel centres, images from pixel edges.
    return ((points - 0.5) * 2**SHIFT).round().to(torch.int32).numpy()


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
