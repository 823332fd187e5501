"""From a photograph to one stroke: resample, flatten the light, threshold, choose components, and measure.

A photograph is rectified and undistorted in one interpolation, or only rescaled, to the raster on which strokes are
measured. All later steps work on `Prepared`: a binary mask and soft ink at 20 px/mm, with the anchor if it is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, Gray
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.errors import CaptureRefused

Soft = NDArray[np.float32]
Mask = NDArray[np.bool_]
Rect = tuple[float, float, float, float]
"""x, y, width and height of a rectangle."""
PX_PER_MM = 20.0
"""Resolution of the raster that strokes are measured on (0.05 mm a pixel)."""
MAX_RASTER_PX = 8192
KNOTS = 8
"""Pixels between computed points of the distortion map; it changes slowly and is interpolated in between."""
BACKGROUND_MM = 32.0
"""Window for estimating the lighting; a stroke thicker than this would be mistaken for shadow."""
CONTRAST_GATE = 0.25
"""Least contrast of the darkest ink; below it the capture is blank, and Otsu would call paper ink."""
SPECK_SHARE = 0.01
"""Components below this share of the main one are specks."""
JOIN_MM = 1.5
"""Components farther than this from the main one belong to other strokes."""
LIGHT_ROUNDS = 5
PAPER_ABOVE = 0.85
"""Share of the fitted light above which a pixel counts as paper."""
MIN_WINDOW_PX = 40
GATE_MM2 = 1.0
NOT_IN_FIELD = "shows no ink near its touch point: an import needs the right start_x_px and start_y_px"
SATURATED = 254
MOST_SATURATED = 0.5
OTHER_MM2 = 2.0
"""Least area of a further component that counts as another stroke, not as a splash."""
GLARE_ABOVE, GLARE_MM2 = 1.12, 2.0
"""Brightness relative to paper, and area, above which glare is flagged; fibres, noise and shadow edges stay below."""
GAP_MM = 1.5
"""Bare streaks and glare narrower than this lie inside a stroke, not between two."""


def rectify(image: Gray, image_to_paper: Floats, window_mm: Rect, px_per_mm: float = PX_PER_MM) -> Gray:
    """Rectify the window (x, y, width, height in the paper frame), row 0 at its far edge (largest y).

    `image_to_paper` has pixel centres on integers, as cv2 does; the result's pixel (i, j) covers [j, j+1) x [i, i+1).
    """
    x, y, width, height = window_mm
    step = 1.0 / px_per_mm
    raster_to_paper = np.array([[step, 0.0, x + 0.5 * step], [0.0, -step, y + height - 0.5 * step], [0.0, 0.0, 1.0]])
    raster_to_image = np.linalg.inv(image_to_paper) @ raster_to_paper
    size = (round(width * px_per_mm), round(height * px_per_mm))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image, raster_to_image, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cast("Gray", warped)


def rescale(image: Gray, px_per_mm: tuple[float, float], where: str) -> Gray:
    """Rescale a photograph of known scale to 20 px/mm. Raises `CaptureRefused` if the result is too small or large."""
    height, width = image.shape
    size = (round(width * PX_PER_MM / px_per_mm[0]), round(height * PX_PER_MM / px_per_mm[1]))
    if not all(8 <= side <= MAX_RASTER_PX for side in size):
        raise CaptureRefused(where, f"is {size[0]} x {size[1]} px at 20 px/mm, allowed 8 to {MAX_RASTER_PX}")
    shrinks = size[0] < width
    return cast("Gray", cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def rectify_by(image: Gray, plane: Plane, window_mm: Rect, where: str) -> Gray:
    """Rectify the window (x, y, width, height in the paper frame) to 20 px/mm, as `rectify` does.

    The photograph is as it was taken; the lens distortion is removed here. Raises `CaptureRefused` if its size is not
    that of the photograph that the plane was seen in.
    """
    plane.lens.check_size(image, where)
    x, y, width, height = window_mm
    columns, rows = round(width * PX_PER_MM), round(height * PX_PER_MM)
    across, along = np.arange(0, columns + KNOTS, KNOTS), np.arange(0, rows + KNOTS, KNOTS)
    grid = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    paper_mm: Floats = np.array([x, y + height], np.float64) + np.array([1.0, -1.0]) * (grid + 0.5) / PX_PER_MM
    knots = plane.to_image(paper_mm).reshape(len(along), len(across), 2).astype(np.float32)
    # Knot k lies at pixel 8 k; cv2.resize would put it in the middle of its eight pixels.
    scale = np.array([[1.0 / KNOTS, 0.0, 0.0], [0.0, 1.0 / KNOTS, 0.0]])
    places = cv2.warpAffine(knots, scale, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    sampled = cv2.remap(image, places, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cast("Gray", sampled)


def on_window(patch_mm: Rect, window_mm: Rect) -> tuple[int, int, int, int]:
    """Convert a patch (x, y, width, height in mm) to pixels of a window's raster: x, y, width, height."""
    x, y, width, height = patch_mm
    top = window_mm[1] + window_mm[3] - (y + height)
    scaled = ((x - window_mm[0]) * PX_PER_MM, top * PX_PER_MM, width * PX_PER_MM, height * PX_PER_MM)
    return round(scaled[0]), round(scaled[1]), round(scaled[2]), round(scaled[3])


@dataclass(frozen=True, slots=True)
class Prepared:
    """A stroke on the 20 px/mm raster."""

    mask: Mask
    """(h, w), True where ink."""
    soft: Soft
    """(h, w) ink from 0 to 1, zero away from the stroke."""
    ink: Mask
    """(h, w), True where darker than the threshold: the stroke, specks and neighbours."""
    anchor_px: tuple[float, float] | None
    """The zero-touch point: (x, y), pixel j covers [j, j + 1)."""
    cut: bool
    """Whether the stroke reaches the edge of its photograph or patch; length and area are then lower bounds."""
    flags: tuple[str, ...] = ()
    """Defects of the capture, although a stroke was found."""


def flatten(raster: Gray, px_per_mm: float = PX_PER_MM) -> Soft:
    """Return reflectance relative to the surrounding paper: 1 is paper under any lighting."""
    # At an eighth of the size: the light is smooth, and a window of 32 mm is 640 px at full size.
    shrink = 8
    small = cv2.resize(raster, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    # Remove the gradient first: closing alone would mistake its dark end for a stroke at the edge.
    slope = light_surface(cast("Gray", small))
    level = (cv2.medianBlur(small, 5) / slope).astype(np.float32)
    side = round(BACKGROUND_MM * px_per_mm / shrink) | 1
    # Closing fills whatever is darker than its surroundings and thinner than the window.
    kernel = np.ones((side, side), np.uint8)
    closed = cv2.morphologyEx(level, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REPLICATE)
    smooth = cv2.GaussianBlur(closed, (0, 0), side / 8.0) * slope
    height, width = raster.shape
    paper = cv2.resize(smooth.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return cast("Soft", raster.astype(np.float32) / np.maximum(paper, 1.0))


def light_surface(small: Gray) -> Floats:
    """Fit a quadratic surface to the paper, (h, w), at least 1; pixels well below it are ink and are left out."""
    height, width = small.shape
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j].reshape(2, -1)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    values = small.astype(np.float64).ravel()
    paper = np.ones(values.size, np.bool_)
    surface = values
    for _ in range(LIGHT_ROUNDS):
        # Normal equations: six columns of order 1 are well conditioned, and a tall solve would start BLAS threads.
        kept = basis[paper]
        coefficients, *_rest = np.linalg.lstsq(kept.T @ kept, kept.T @ values[paper], rcond=None)
        surface = np.maximum(basis @ coefficients, 1.0)
        paper = values > PAPER_ABOVE * surface
        if np.count_nonzero(paper) < 6 * basis.shape[1]:
            return np.full(small.shape, max(float(np.median(values)), 1.0))
    return surface.reshape(small.shape)


def prepare(
    raster: Gray,
    anchor_px: tuple[float, float] | None,
    where: str,
    patch_px: tuple[int, int, int, int] | None = None,
    join_mm: float = JOIN_MM,
    speck_share: float = SPECK_SHARE,
) -> Prepared:
    """Find the stroke on a 20 px/mm raster. `patch_px` (x, y, w, h) hides everything outside the patch.

    `join_mm` and `speck_share` say which components belong to the stroke. Raises `CaptureRefused` if the raster shows
    too little of the patch or is blank, or nothing is left after cleaning.
    """
    height, width = raster.shape
    x, y, w, h = patch_px if patch_px is not None else (0, 0, width, height)
    window = slice(max(y, 0), min(y + h, height)), slice(max(x, 0), min(x + w, width))
    if min(side.stop - side.start for side in window) < MIN_WINDOW_PX:
        raise CaptureRefused(where, "shows less than 2 mm of the stroke's patch")
    # Only the patch: neighbours' ink and the table's edge would distort the estimated lighting.
    reflectance = np.ones(raster.shape, np.float32)
    reflectance[window] = flatten(raster[window])
    # The darkest GATE_MM2 is an area rather than a share, so that the picture's size does not matter.
    pixels = reflectance[window].ravel()
    kth = min(round(GATE_MM2 * PX_PER_MM**2), pixels.size - 1)
    contrast = 1.0 - float(np.partition(pixels, kth)[kth])
    if contrast < CONTRAST_GATE:
        raise CaptureRefused(where, f"is blank: at most {contrast:.2f} darker than paper, {CONTRAST_GATE} is needed")
    levels = np.clip(reflectance * 255.0, 0.0, 255.0).astype(np.uint8)
    otsu, _ = cv2.threshold(levels[window], 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    ink = levels <= round(otsu)
    mask, others_mm2 = components(ink, anchor_px, join_mm, speck_share)
    if not mask.any():
        raise CaptureRefused(where, "holds no stroke after specks and neighbours were removed")
    flags = _flags(raster[window], mask[window], others_mm2)
    return Prepared(mask, _soft_ink(reflectance, mask), ink, anchor_px, touches_edge(mask[window]), flags)


def _soft_ink(reflectance: Soft, mask: Mask) -> Soft:
    """Ink from 0 (paper) to 1 (the stroke's median), zero more than four pixels away from the stroke."""
    ink = float(np.median(reflectance[mask]))
    near = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    soft = np.clip((1.0 - reflectance) / max(1.0 - ink, 1e-3), 0.0, 1.0)
    return np.where(near, soft, 0.0).astype(np.float32)


def _flags(raster: Gray, mask: Mask, others_mm2: Sequence[float]) -> tuple[str, ...]:
    """Defects of a capture that can still be used."""
    flags: list[str] = []
    saturated = float(np.count_nonzero(raster >= SATURATED)) / raster.size
    if saturated > MOST_SATURATED:
        flags.append(f"saturated: {100 * saturated:.0f} % of the pixels are white, so the light cannot be judged")
    if touches_edge(mask):
        flags.append("cut: the stroke reaches the edge of its photograph or patch")
    others = [area for area in others_mm2 if area >= OTHER_MM2]
    if others:
        flags.append(f"others: {len(others)} more strokes lie in the crop, {sum(others):.0f} mm2 in all")
    shrink = 16
    small = cast("Gray", cv2.resize(raster, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA))
    bright = np.count_nonzero(small > GLARE_ABOVE * light_surface(small))
    glare = float(bright) * (shrink / PX_PER_MM) ** 2
    if glare > GLARE_MM2:
        flags.append(f"glare: {glare:.1f} mm2 are brighter than paper under this light")
    return tuple(flags)


def touches_edge(mask: Mask) -> bool:
    """Whether ink lies in the outermost rows or columns."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def components(
    ink: Mask, anchor_px: tuple[float, float] | None, join_mm: float = JOIN_MM, speck_share: float = SPECK_SHARE
) -> tuple[Mask, list[float]]:
    """The stroke, (h, w): the main component, and parts close to it that are not specks; and the areas of others, mm2.

    The main component is the largest; with an anchor, the largest of those that come within `join_mm` of it, if any.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8), connectivity=8)
    if count <= 1:
        return np.zeros_like(ink), []
    areas = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.int64)
    candidates = np.arange(1, count)
    if anchor_px is not None:
        y, x = np.ogrid[: ink.shape[0], : ink.shape[1]]
        away_px2 = (x + 0.5 - anchor_px[0]) ** 2 + (y + 0.5 - anchor_px[1]) ** 2
        near = np.setdiff1d(np.asarray(labels)[away_px2 <= (join_mm * PX_PER_MM) ** 2], [0])
        near = near[areas[near - 1] >= speck_share * areas.max()]
        candidates = near if near.size else candidates
    main = int(candidates[np.argmax(areas[candidates - 1])])
    others = [k for k in range(1, count) if k != main and areas[k - 1] >= speck_share * areas[main - 1]]
    joined = parts_near(labels, main, others, join_mm * PX_PER_MM)
    others_mm2 = [float(areas[label - 1]) / PX_PER_MM**2 for label in others if label not in joined]
    return np.isin(labels, [main, *joined]), others_mm2


def parts_near(labels: cv2.typing.MatLike, main: int, others: list[int], reach_px: float) -> list[int]:
    """Those of the `others` that come within `reach_px` of the component `main`; `labels` (h, w) numbers them all."""
    if not others:
        return []
    away_px = np.asarray(cv2.distanceTransform((labels != main).astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    return [label for label in others if float(away_px[labels == label].min()) <= reach_px]


@dataclass(frozen=True, slots=True)
class Measured:
    """A stroke's size. `heading` is the image's x axis."""

    length_mm: float
    """Extent along the heading."""
    width_mm: float
    """Diameter of the largest circle that fits inside the outline: the greatest width, also of a bent stroke."""
    mid_width_mm: float
    """The same over the middle third of the length, without the blobs where a drag begins and ends."""
    breadth_mm: float
    """Greatest extent across the heading; equals the width only for a straight stroke."""
    area_mm2: float
    """Area of the ink, without its holes."""


def measure(mask: Mask) -> Measured:
    """Measure a non-empty mask at 20 px/mm."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    stroke = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    filled = outline(stroke)
    inside = cv2.distanceTransform(np.pad(filled, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[:, 1:-1]
    third = stroke.shape[1] // 3
    middle = inside[:, third : stroke.shape[1] - third]
    return Measured(
        length_mm=stroke.shape[1] / PX_PER_MM,
        width_mm=_diameter_mm(float(inside.max())),
        mid_width_mm=_diameter_mm(float(middle.max())),
        breadth_mm=float(filled.sum(axis=0).max()) / PX_PER_MM,
        area_mm2=float(np.count_nonzero(stroke)) / PX_PER_MM**2,
    )


def outline(mask: Mask) -> NDArray[np.uint8]:
    """The mask with gaps of up to `GAP_MM` closed and holes filled: glare and bare bristles do not narrow a stroke."""
    side = round(GAP_MM * PX_PER_MM) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    # Padded, so that the border of the image counts as paper and closing has room.
    padded = cv2.morphologyEx(np.pad(mask.astype(np.uint8), side), cv2.MORPH_CLOSE, kernel)
    paper = padded.copy()
    cv2.floodFill(paper, None, (0, 0), (1,))
    filled = np.where(paper == 0, 1, padded).astype(np.uint8)
    return filled[side:-side, side:-side]


def _diameter_mm(reach_px: float) -> float:
    # The transform measures to the centre of the nearest paper pixel, half a pixel farther than the edge.
    return 2.0 * (reach_px - 0.5) / PX_PER_MM
