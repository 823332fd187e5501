"""From a photograph to a stroke: rectify to 20 px/mm, flatten the light, gate, threshold, choose components.

Everything after this works on `Prepared`: a binary mask and soft ink at 20 px/mm with the anchor known, if it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.errors import CaptureRefused

Gray = NDArray[np.uint8]
Soft = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

PX_PER_MM = 20.0
"""The raster that strokes are measured on (0.05 mm a pixel)."""
MAX_RASTER_PX = 8192
MIN_WINDOW_PX = 40
LIGHT_ROUNDS = 5
GATE_MM2 = 1.0
PAPER_ABOVE = 0.85
"""Share of the fitted light above which a pixel counts as paper."""


@dataclass(frozen=True, slots=True)
class Params:
    """Named parameters of the preprocessing; they go into the calibration's artefact."""

    background_mm: float = 32.0
    """Size of the window that follows the light; a stroke thicker than this would be taken for shadow."""
    contrast_gate: float = 0.25
    """Darkest ink must lie this far below paper, else the capture is blank: Otsu would call paper ink."""
    speck_share: float = 0.01
    """Components below this share of the main one are specks."""
    join_mm: float = 1.5
    """Components farther than this from the main one belong to somebody else."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A stroke on the 20 px/mm raster."""

    mask: Mask
    """(h, w), True where ink."""
    soft: Soft
    """(h, w) ink from 0 to 1, zero away from the stroke."""
    anchor_px: tuple[float, float] | None
    """The zero-touch point: (x, y), pixel j covers [j, j + 1)."""
    threshold: float
    """Reflectance below which a pixel counts as ink."""
    cut: bool
    """True where the stroke reaches the edge of its photograph or cell: its length and area are lower bounds."""


def rectify(image: Gray, image_to_paper: Floats, window_mm: tuple[float, float, float, float]) -> Gray:
    """The window (x, y, width, height in the paper frame) at 20 px/mm, row 0 at its far edge (largest y).

    `image_to_paper` has pixel centres on integers, as cv2 does; the result's pixel (i, j) covers [j, j+1) x [i, i+1).
    """
    x, y, width, height = window_mm
    step = 1.0 / PX_PER_MM
    raster_to_paper = np.array([[step, 0.0, x + 0.5 * step], [0.0, -step, y + height - 0.5 * step], [0.0, 0.0, 1.0]])
    raster_to_image = np.linalg.inv(image_to_paper) @ raster_to_paper
    size = (round(width * PX_PER_MM), round(height * PX_PER_MM))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image, raster_to_image, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cast("Gray", warped)


def rescale(image: Gray, px_per_mm: tuple[float, float], where: str) -> Gray:
    """A photograph of known scale on the 20 px/mm raster. Raises `CaptureRefused` where that would be huge."""
    height, width = image.shape
    size = (round(width * PX_PER_MM / px_per_mm[0]), round(height * PX_PER_MM / px_per_mm[1]))
    if not all(8 <= side <= MAX_RASTER_PX for side in size):
        raise CaptureRefused(where, f"is {size[0]} x {size[1]} px at 20 px/mm, allowed 8 to {MAX_RASTER_PX}")
    shrinks = size[0] < width
    return cast("Gray", cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def on_raster(point_px: tuple[float, float], px_per_mm: tuple[float, float]) -> tuple[float, float]:
    """A point of a photograph on the raster that `rescale` makes of it."""
    return point_px[0] * PX_PER_MM / px_per_mm[0], point_px[1] * PX_PER_MM / px_per_mm[1]


def prepare(
    raster: Gray,
    anchor_px: tuple[float, float] | None,
    where: str,
    params: Params,
    cell_px: tuple[int, int, int, int] | None = None,
) -> Prepared:
    """Find the stroke on a 20 px/mm raster. `cell_px` (x, y, w, h) hides what lies outside the paper cell.

    Raises `CaptureRefused` for a blank raster, or where nothing is left after cleaning.
    """
    window = _window(raster, cell_px, where)
    # Only the cell: neighbours' ink and the table's edge are no paper to measure the light by.
    reflectance = np.ones(raster.shape, np.float32)
    reflectance[window] = flatten(raster[window], params)
    # The reflectance that at least GATE_MM2 of ink stays under: an area, so that the picture's size does not matter.
    pixels = reflectance[window].ravel()
    kth = min(round(GATE_MM2 * PX_PER_MM**2), pixels.size - 1)
    darkest = float(np.partition(pixels, kth)[kth])
    if 1.0 - darkest < params.contrast_gate:
        raise CaptureRefused(
            where, f"is blank: darkest ink {1.0 - darkest:.2f} below paper, gate {params.contrast_gate}"
        )
    levels = np.clip(reflectance * 255.0, 0.0, 255.0).astype(np.uint8)
    otsu, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    threshold = otsu / 255.0
    mask = choose(levels <= otsu, anchor_px, params)
    if not mask.any():
        raise CaptureRefused(where, "holds no stroke after specks and neighbours were removed")
    ink = float(np.median(reflectance[mask]))
    near = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    soft = np.clip((1.0 - reflectance) / max(1.0 - ink, 1e-3), 0.0, 1.0)
    return Prepared(
        mask, np.where(near, soft, 0.0).astype(np.float32), anchor_px, threshold, _touches_edge(mask[window])
    )


def flatten(raster: Gray, params: Params) -> Soft:
    """Reflectance relative to the paper around it: 1 is paper, whatever the light does."""
    # At an eighth of the size: the light is smooth, and a window of 32 mm is 640 px at full size.
    shrink = 8
    small = cv2.resize(raster, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    # The slope of the light first: closing alone would take the dark end of a slope for a stroke at the edge.
    slope = light_surface(cast("Gray", small))
    level = (cv2.medianBlur(small, 5) / slope).astype(np.float32)
    side = round(params.background_mm * PX_PER_MM / shrink) | 1
    # Closing fills whatever is darker than its surroundings and thinner than the window.
    kernel = np.ones((side, side), np.uint8)
    closed = cv2.morphologyEx(level, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REPLICATE)
    smooth = cv2.GaussianBlur(closed, (0, 0), side / 8.0) * slope
    height, width = raster.shape
    paper = cv2.resize(smooth.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return cast("Soft", raster.astype(np.float32) / np.maximum(paper, 1.0))


def light_surface(small: Gray) -> Floats:
    """A quadratic surface through the paper, (h, w), at least 1: pixels well below it are ink and left out."""
    height, width = small.shape
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    values = small.astype(np.float64).ravel()
    paper = np.ones(values.size, np.bool_)
    surface = values
    for _ in range(LIGHT_ROUNDS):
        coefficients, *_rest = np.linalg.lstsq(basis[paper], values[paper], rcond=None)
        surface = np.maximum(basis @ coefficients, 1.0)
        paper = values > PAPER_ABOVE * surface
        if np.count_nonzero(paper) < 6 * basis.shape[1]:
            return np.full(small.shape, max(float(np.median(values)), 1.0))
    return surface.reshape(small.shape)


def choose(ink: Mask, anchor_px: tuple[float, float] | None, params: Params) -> Mask:
    """The stroke among the components: the main one, and parts that are no specks and lie close to it.

    The main component is the largest; with an anchor, the largest of those that come within `join_mm` of it, if any.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8), connectivity=8)
    if count <= 1:
        return np.zeros_like(ink)
    areas = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.int64)
    candidates = np.arange(1, count)
    if anchor_px is not None:
        near = _within(labels.astype(np.int32), anchor_px, params.join_mm * PX_PER_MM)
        near = near[areas[near - 1] >= params.speck_share * areas.max()]
        candidates = near if near.size else candidates
    main = int(candidates[np.argmax(areas[candidates - 1])])
    stroke = labels == main
    others = [k for k in range(1, count) if k != main and areas[k - 1] >= params.speck_share * areas[main - 1]]
    if not others:
        return stroke
    away = np.asarray(cv2.distanceTransform((~stroke).astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    for label in others:
        part = labels == label
        if float(away[part].min()) <= params.join_mm * PX_PER_MM:
            stroke |= part
    return stroke


def _window(raster: Gray, cell_px: tuple[int, int, int, int] | None, where: str) -> tuple[slice, slice]:
    height, width = raster.shape
    x, y, w, h = cell_px if cell_px is not None else (0, 0, width, height)
    rows, columns = slice(max(y, 0), min(y + h, height)), slice(max(x, 0), min(x + w, width))
    if rows.stop - rows.start < MIN_WINDOW_PX or columns.stop - columns.start < MIN_WINDOW_PX:
        raise CaptureRefused(where, "shows less than 2 mm of the stroke's paper cell")
    return rows, columns


def _touches_edge(mask: Mask) -> bool:
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def _within(labels: NDArray[np.int32], point: tuple[float, float], radius: float) -> NDArray[np.int64]:
    height, width = labels.shape
    reach = int(radius) + 1
    rows = slice(max(int(point[1]) - reach, 0), min(int(point[1]) + reach + 1, height))
    columns = slice(max(int(point[0]) - reach, 0), min(int(point[0]) + reach + 1, width))
    ys, xs = np.ogrid[rows, columns]
    close = (xs + 0.5 - point[0]) ** 2 + (ys + 0.5 - point[1]) ** 2 <= radius**2
    found = np.unique(labels[rows, columns][close]).astype(np.int64)
    return found[found > 0]
