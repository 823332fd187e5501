"""How fast marks become images, and presses are recovered from them: `bench raster` and `bench inversion`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import Result, at_most, interleave, machine, rounds_of
from brushloop.calibrate.stats import NORMAL_95
from brushloop.model.ccdbsm import Brush, ccdbsm
from brushloop.model.inversion import PARAMETERS, Inverter
from brushloop.model.raster import PX_MM, SIZE_PX, coverage
from brushloop.model.raster.centred import press_images
from brushloop.model.strokes import stroke_model

BATCH = 256
CALLS = 4  # a single short call would mostly measure caches that the peer has emptied
SCALE = 4
POINTS = 64  # along each side of an outline
SHIFT = 4  # fractional bits of fillPoly's fixed-point corners
DRAWS, SENSOR = 600, 0.05
"""Presses to recover, and the standard deviation of the sensor's noise, of full ink."""
INVERTED_PX_MM = 0.25  # so that an anchored press fits into 128 pixels
INVERTED_MS, WORST_MM, WORST_DEG, BINARY_MM = 20.0, 0.001, 0.05, 0.02
Floats = NDArray[np.float64]


def raster(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Images per second of exact CCD-BSM coverage, 128 x 128, beside cv2.fillPoly at 4x with resize.

    Presses are drawn from H 11-20 mm, alpha 0-10 deg, heading 0, each in the middle of its image; both sides draw the
    same ones. Ours counts everything from (H, alpha) to float32 images in memory that is used again; fillPoly gets its
    outlines ready made and gives 8-bit images, is not exact (it paints its boundary pixels whole, so its marks come out
    about 1 % too large, and at 4x it knows 17 levels of gray), and each of its images is a zeroed canvas, a fill and an
    area mean. 256 images a call, on one thread.

    ratio = our images/s over the peer's, in CPU seconds and means of the quickest tenth of the rounds:
    other work on the machine only ever slows.
    """
    rounds, rng, brush = rounds_of(n, 60), np.random.default_rng(seed), Brush()
    depth_mm, tilt_deg = rng.uniform(11, 20, BATCH), rng.uniform(0, 10, BATCH)
    images = np.empty((BATCH, SIZE_PX, SIZE_PX), np.float32)
    polygons = outlines(depth_mm, tilt_deg)

    def ours() -> None:
        for _ in range(CALLS):
            press_images(ccdbsm(brush, depth_mm, tilt_deg), out=images)

    def peer() -> None:
        for polygon in polygons:
            fill(polygon)

    with _one_thread():
        turns = interleave(ours, peer, rounds, time.process_time)
    ours_s, peer_s = turns.quickest_s[0] / (CALLS * BATCH), turns.quickest_s[1] / BATCH
    ratio, of = peer_s / ours_s, "cv2.fillPoly at 4x"
    return [Result("raster-press", 1 / ours_s, "images/s", of, ratio, rounds, seed, machine(), *turns.ratios(CALLS))]


def outlines(depth_mm: Floats, tilt_deg: Floats) -> NDArray[np.int32]:
    """The marks of these presses as polygons in fillPoly's fixed-point pixels at 4x, (B, 2 POINTS, 2)."""
    mark = ccdbsm(Brush(), depth_mm, tilt_deg)
    # Points crowd at both ends, where the outline turns fastest.
    share = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, POINTS))
    x = mark.x_min_mm[:, None] + share * mark.length_mm[:, None]
    width = mark.half_width(x)
    x, y = np.concatenate((x, x[:, ::-1]), axis=1), np.concatenate((width, -width[:, ::-1]), axis=1)
    # fillPoly counts from pixel centres, images from pixel edges.
    points = np.stack((x - mark.middle_mm[:, None], -y), axis=-1) * SCALE / PX_MM + 0.5 * SCALE * SIZE_PX - 0.5
    return np.rint(points * 2**SHIFT).astype(np.int32)


def fill(polygon: NDArray[np.int32]) -> NDArray[np.uint8]:
    """One polygon filled at 4x and averaged down to 128 x 128, 0-255."""
    canvas = np.zeros((SCALE * SIZE_PX, SCALE * SIZE_PX), np.uint8)
    cv2.fillPoly(canvas, [polygon], 255, shift=SHIFT)
    return cv2.resize(canvas, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def inversion(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Recover `n` drawn presses (600) whose zero-touch point is known: H 11-20 mm, alpha 0-10 deg, 0.25 mm/px.

    Worst errors on images as they are drawn, mean error on binary ones, how often 95 % intervals hold the truth on
    images with noise, and thread CPU time from images to intervals. For a few draws a share of intervals says nothing.
    """
    count, rng = rounds_of(n, DRAWS), np.random.default_rng(seed)
    truth = {"depth_mm": rng.uniform(11, 20, count), "tilt_deg": rng.uniform(0, 10, count)}
    anchor = np.array([0.8, 0.5]) * SIZE_PX * INVERTED_PX_MM + rng.uniform(-0.5, 0.5, (count, 2)) * INVERTED_PX_MM
    origin = anchor + np.column_stack((truth["depth_mm"] * np.tan(np.radians(truth["tilt_deg"])), np.zeros(count)))
    clean = coverage(ccdbsm(Brush(), truth["depth_mm"], truth["tilt_deg"]).outline(), origin, px_mm=INVERTED_PX_MM)
    noisy = (clean + rng.normal(0, SENSOR, clean.shape)).astype(np.float32)
    inverter = Inverter(stroke_model("ccd-bsm", Brush()), px_mm=INVERTED_PX_MM)
    with _one_thread():
        inverter(clean[:2], anchor[:2])  # compiles
        began = time.thread_time()
        found = inverter(clean, anchor)
        each_ms = 1e3 * (time.thread_time() - began) / count
        binary, seen = inverter((clean > 0.5).astype(np.float32), anchor), inverter(noisy, anchor)
    off = {name: np.abs(getattr(found, name) - true).max() for name, true in truth.items()}
    binary_mm = float(np.abs(binary.depth_mm - truth["depth_mm"]).mean())
    results = [
        at_most("inversion.time", each_ms, "ms an image", INVERTED_MS, count, seed),
        at_most("inversion.H worst", float(off["depth_mm"]), "mm", WORST_MM, count, seed),
        at_most("inversion.alpha worst", float(off["tilt_deg"]), "deg", WORST_DEG, count, seed),
        at_most("inversion.binary H mean", binary_mm, "mm", BINARY_MM, count, seed),
    ]
    for name, true in truth.items():
        k = PARAMETERS.index(name)
        share = 100.0 * float((np.abs(seen.values[:, k] - true) <= NORMAL_95 * seen.sigma[:, k]).mean())
        label = f"inversion.noisy {'H' if name == 'depth_mm' else 'alpha'} in interval"
        results.append(Result(label, share, "%", "the nominal 95 %", share / 95.0, count, seed, machine()))
    return results


@contextmanager
def _one_thread() -> Iterator[None]:
    """Hold OpenCV to one thread, and restore what was set before."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
