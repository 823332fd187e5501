"""From a photograph to a stroke: rectify to 20 px/mm, flatten the light, gate, threshold, choose components.

Everything after this works on `Prepared`: a binary mask and soft ink at 20 px/mm with the anchor known, if it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from calibrate.errors import CaptureRefused
from calibrate.stroke.components import Chosen, choose, components, fill_holes
from calibrate.stroke.light import flatten, light_surface
from calibrate.stroke.params import PX_PER_MM, Floats, Gray, Mask, Params, Soft

__all__ = [
    "PX_PER_MM",
    "Floats",
    "Gray",
    "Level",
    "Mask",
    "Params",
    "Prepared",
    "Soft",
    "choose",
    "flatten",
    "light_surface",
    "on_raster",
    "prepare",
    "rectify",
    "rescale",
]


MAX_RASTER_PX = 8192
MIN_WINDOW_PX = 40
GATE_MM2 = 1.0
SATURATED = 254
MOST_SATURATED = 0.5
OTHER_MM2 = 2.0
"""Foreign ink from which a component is somebody else's stroke and no splash."""
GLARE_ABOVE, GLARE_MM2 = 1.12, 2.0
"""Fibres, noise and the edge of a shadow stay below this share of the light; more of it is a lamp's reflection."""


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
    flags: tuple[str, ...] = ()
    """What is not as it should be, though a stroke was found."""


@dataclass(frozen=True, slots=True)
class Level:
    """Where ink ends and paper begins, as fitted on one capture."""

    darkest: float
    """Reflectance that `GATE_MM2` of ink stays under."""
    threshold: float
    """By Otsu's method, on 256 levels."""


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
    window = cell_window(raster, cell_px, where)
    # Only the cell: neighbours' ink and the table's edge are no paper to measure the light by.
    reflectance = np.ones(raster.shape, np.float32)
    reflectance[window] = flatten(raster[window], params)
    level = find_level(reflectance[window], where, params)
    chosen = components(to_levels(reflectance) <= round(255.0 * level.threshold), anchor_px, params)
    if not chosen.mask.any():
        raise CaptureRefused(where, "holds no stroke after specks and neighbours were removed")
    mask = fill_holes(chosen.mask, params)
    soft = soft_ink(reflectance, chosen.mask)
    flags = raise_flags(raster[window], mask[window], chosen)
    return Prepared(mask, soft, anchor_px, level.threshold, touches_edge(mask[window]), flags)


def find_level(reflectance: Soft, where: str, params: Params) -> Level:
    """The contrast gate, then Otsu's threshold. Raises `CaptureRefused` where there is no ink to speak of."""
    # The reflectance that at least GATE_MM2 of ink stays under: an area, so that the picture's size does not matter.
    pixels = reflectance.ravel()
    kth = min(round(GATE_MM2 * PX_PER_MM**2), pixels.size - 1)
    darkest = float(np.partition(pixels, kth)[kth])
    if 1.0 - darkest < params.contrast_gate:
        raise CaptureRefused(
            where, f"is blank: darkest ink {1.0 - darkest:.2f} below paper, gate {params.contrast_gate}"
        )
    otsu, _ = cv2.threshold(to_levels(reflectance), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return Level(darkest, otsu / 255.0)


def to_levels(reflectance: Soft) -> Gray:
    """Reflectance 0 to 1 on 256 levels."""
    return np.clip(reflectance * 255.0, 0.0, 255.0).astype(np.uint8)


def soft_ink(reflectance: Soft, mask: Mask) -> Soft:
    """Ink from 0 (paper) to 1 (the stroke's median), zero more than four pixels away from the stroke."""
    ink = float(np.median(reflectance[mask]))
    near = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    soft = np.clip((1.0 - reflectance) / max(1.0 - ink, 1e-3), 0.0, 1.0)
    return np.where(near, soft, 0.0).astype(np.float32)


def raise_flags(raster: Gray, mask: Mask, chosen: Chosen) -> tuple[str, ...]:
    """What an operator should know of a capture that can be used."""
    told: list[str] = []
    saturated = float(np.count_nonzero(raster >= SATURATED)) / raster.size
    if saturated > MOST_SATURATED:
        told.append(f"saturated: {100 * saturated:.0f} % of the pixels are white, the light cannot be judged")
    if touches_edge(mask):
        told.append("cut: the stroke reaches the edge of its photograph or cell")
    others = [area for area in chosen.others_mm2 if area >= OTHER_MM2]
    if others:
        told.append(f"others: {len(others)} more strokes of {sum(others):.0f} mm2 in the crop")
    shrink = 16
    small = cast("Gray", cv2.resize(raster, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA))
    bright = np.count_nonzero(small > GLARE_ABOVE * light_surface(small))
    glare = float(bright) * (shrink / PX_PER_MM) ** 2
    if glare > GLARE_MM2:
        told.append(f"glare: {glare:.1f} mm2 are brighter than paper under this light")
    return tuple(told)


def on_window(
    cell_mm: tuple[float, float, float, float], window_mm: tuple[float, float, float, float]
) -> tuple[int, int, int, int]:
    """A paper cell (x, y, width, height in mm) as pixels of the raster of a window: x, y, width, height."""
    x, y, width, height = cell_mm
    top = window_mm[1] + window_mm[3] - (y + height)
    scaled = ((x - window_mm[0]) * PX_PER_MM, top * PX_PER_MM, width * PX_PER_MM, height * PX_PER_MM)
    return round(scaled[0]), round(scaled[1]), round(scaled[2]), round(scaled[3])


def cell_window(raster: Gray, cell_px: tuple[int, int, int, int] | None, where: str) -> tuple[slice, slice]:
    """Rows and columns of the raster that show the paper cell; all where there is none. Raises `CaptureRefused`."""
    height, width = raster.shape
    x, y, w, h = cell_px if cell_px is not None else (0, 0, width, height)
    rows, columns = slice(max(y, 0), min(y + h, height)), slice(max(x, 0), min(x + w, width))
    if rows.stop - rows.start < MIN_WINDOW_PX or columns.stop - columns.start < MIN_WINDOW_PX:
        raise CaptureRefused(where, "shows less than 2 mm of the stroke's paper cell")
    return rows, columns


def touches_edge(mask: Mask) -> bool:
    """Whether ink lies in the outermost rows or columns."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
