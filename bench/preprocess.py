"""How fast a photograph becomes a 128 x 128 stroke, beside the same steps by scikit-image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import skimage.filters
import skimage.measure
import skimage.morphology
import skimage.transform
from numpy.typing import NDArray

from bench.harness import Result, interleave, machine
from brushloop.calibrate.stroke.params import PX_PER_MM, Params
from brushloop.calibrate.stroke.preprocess import prepare
from brushloop.calibrate.stroke.rectify import rectify

SIDE_MM = 25.6
SIZE_PX = 128
SHRINK = 8
"""Both follow the light on an eighth of the size."""
IMAGES = 4


def run(*, n: int | None = None, seed: int = 0) -> Result:
    """Images per second from a 6.25 px/mm photograph of 480 x 480 px to a binary stroke of 128 x 128.

    ratio = ours over the peer's, one thread each. Both rectify a window of 25.6 mm to 20 px/mm by a homography, flatten
    the light by a closing and a blur of the same size at an eighth of the size, gate, threshold by Otsu, keep the main
    component without specks, and average down. Ours also fits the slope of the light, and joins broken parts.
    """
    rounds = 10 if n is None else n
    rng = np.random.default_rng(seed)
    photographs = [_photograph(rng) for _ in range(IMAGES)]
    to_paper = np.array([[0.16, 0.0004, -25.0], [0.0003, -0.16, 50.0], [0.0, 1e-6, 1.0]])
    window = (0.5, -1.0, SIDE_MM, SIDE_MM)
    params = Params()

    def ours() -> object:
        return [_ours(image, to_paper, window, params) for image in photographs]

    def peer() -> object:
        return [_peer(image, to_paper, window, params) for image in photographs]

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        agree = np.mean([_iou(a, b) for a, b in zip(ours_of(ours()), ours_of(peer()), strict=True)])
        if agree < 0.97:
            raise RuntimeError(f"the two do not make the same strokes: IoU {agree:.3f}")
        turns = interleave(ours, peer, rounds)
    finally:
        cv2.setNumThreads(before)
    ours_s, peer_s = turns.median_s
    return Result(
        name="preprocess",
        value=IMAGES / ours_s,
        unit="images/s",
        peer="scikit-image",
        ratio=peer_s / ours_s,
        n=rounds,
        seed=seed,
        conditions=f"{machine()}; the strokes of both agree to IoU {agree:.3f}",
        **turns.ratios(),
    )


def ours_of(made: object) -> list[NDArray[np.bool_]]:
    """The strokes of one round."""
    assert isinstance(made, list)
    return made


def _ours(
    image: NDArray[np.uint8],
    to_paper: NDArray[np.float64],
    window: tuple[float, float, float, float],
    params: Params,
) -> NDArray[np.bool_]:
    stroke = prepare(rectify(image, to_paper, window), None, "bench", params)
    small = cv2.resize(stroke.mask.astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) > 0.5


def _peer(
    image: NDArray[np.uint8],
    to_paper: NDArray[np.float64],
    window: tuple[float, float, float, float],
    params: Params,
) -> NDArray[np.bool_]:
    ski: Any = skimage
    x, y, width, height = window
    step = 1.0 / PX_PER_MM
    to_mm = np.array([[step, 0.0, x + 0.5 * step], [0.0, -step, y + height - 0.5 * step], [0.0, 0.0, 1.0]])
    shape = (round(height * PX_PER_MM), round(width * PX_PER_MM))
    place = ski.transform.ProjectiveTransform(np.linalg.inv(to_paper) @ to_mm)
    raster = ski.transform.warp(image, place, output_shape=shape, order=1, mode="edge", preserve_range=True)
    small = ski.transform.downscale_local_mean(raster, (SHRINK, SHRINK))
    side = round(params.background_mm * PX_PER_MM / SHRINK) | 1
    footprint = ski.morphology.footprint_rectangle((side, side))
    closed = ski.morphology.closing(small, footprint, mode="reflect")
    paper = ski.transform.resize(ski.filters.gaussian(closed, side / 8.0), shape, order=1)
    reflectance = raster / np.maximum(paper, 1.0)
    if 1.0 - np.partition(reflectance.ravel(), 400)[400] < params.contrast_gate:
        raise RuntimeError("blank")
    labels = ski.measure.label(reflectance <= ski.filters.threshold_otsu(reflectance), connectivity=2)
    parts = ski.measure.regionprops(labels)
    main = max(parts, key=lambda part: part.area)
    stroke = labels == main.label
    return ski.transform.downscale_local_mean(stroke.astype(np.float32), (4, 4)) > 0.5


def _photograph(rng: np.random.Generator) -> NDArray[np.uint8]:
    image = np.full((480, 480), 1.0, np.float32)
    # Between paper 0.5 .. 26 mm: pixels 160 .. 315 across, 155 .. 315 down.
    place = (238 + int(rng.integers(-6, 7)), 236 + int(rng.integers(-6, 7)))
    cv2.ellipse(image, place, (52, 20), float(rng.uniform(-8, 8)), 0, 360, 0.1, -1)
    for speck in rng.integers(170, 300, (6, 2)):
        cv2.circle(image, (int(speck[0]), int(speck[1])), 1, 0.3, -1)
    light = 225.0 * (1.0 - 0.25 * np.linspace(0, 1, 480, dtype=np.float32)[None, :])
    noisy = cv2.GaussianBlur(image, (0, 0), 0.8) * light + rng.normal(0, 2.0, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def _iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))
