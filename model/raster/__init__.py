"""The definition of position, heading and pixel that all code uses, and outlines to exact coverage in bulk.

Illustrated in `docs/models.md`. Stroke frame: x along the stroke axis, positive toward the belly, heel and ferrule; y
to the left of +x; the origin is O3, where the brush axis meets the paper. Lengths are mm.
Image: square; the column grows to the right, the row downwards. Pixel (i, j) is the square between row edges i and
i + 1 and column edges j and j + 1, so its centre is (i + 1/2, j + 1/2) pixels from the top left corner.
`origin_mm` is where O3 lies in the image: (mm from the left edge, mm from the top edge). `heading_deg` is where +x
points: 0 is to the right, 90 up, counter-clockwise. A point (x, y) of the stroke lies at
    column = (origin_x + x cos(heading) - y sin(heading)) / px,
    row    = (origin_y - x sin(heading) - y cos(heading)) / px.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brushloop.model.outline import Array, Outline

SIZE_PX = 128
PX_MM = 0.2
Images = NDArray[np.float32]


def coverage(
    outline: Outline,
    origin_mm: Array,
    heading_deg: Array = 0.0,
    *,
    size_px: int = SIZE_PX,
    px_mm: float = PX_MM,
) -> Images:
    """The covered share of every pixel, (B, size_px, size_px) in [0, 1], of B outlines, by compiled loops.

    `origin_mm` is (2,) or (B, 2), `heading_deg` a scalar or (B,). The error stays below 1e-6. Raises ValueError for an
    invalid size or shape, and for an outline that is not finite.
    """
    from brushloop.model.raster.kernel import rasterise  # numba takes a fifth of a second to import

    check_raster(size_px, px_mm)
    points, weights = (np.ascontiguousarray(part, np.float64) for part in (outline.points, outline.weights))
    out = np.empty((len(points), size_px, size_px), np.float32)
    rasterise(points, weights, to_pixels(origin_mm, heading_deg, px_mm, len(points)), out)
    return out


def check_raster(size_px: int, px_mm: float) -> None:
    """Raise ValueError unless the raster has pixels of a positive size."""
    if size_px < 1 or not px_mm > 0:
        raise ValueError(f"size_px = {size_px}, px_mm = {px_mm:g}: both must be positive")


def to_pixels(origin_mm: Array, heading_deg: Array, px_mm: float, marks: int) -> Array:
    """The map of the module's last two lines for `marks` marks, (B, 6): column = m0 x + m1 y + m2, row = m3 x + m4 y +
    m5.

    Raises ValueError for an origin or headings of another number of marks.
    """
    origin, heading = np.asarray(origin_mm, np.float64), np.deg2rad(np.asarray(heading_deg, np.float64))
    if origin.shape not in ((2,), (marks, 2)):
        raise ValueError(f"origin_mm has shape {origin.shape}, expected (2,) or ({marks}, 2)")
    if heading.shape not in ((), (1,), (marks,)):
        raise ValueError(f"heading_deg has shape {heading.shape}, expected a scalar or ({marks},)")
    origin = np.broadcast_to(origin, (marks, 2)) / px_mm
    cosine, sine = (np.broadcast_to(part, (marks,)) / px_mm for part in (np.cos(heading), np.sin(heading)))
    return np.stack((cosine, -sine, origin[:, 0], -sine, -cosine, origin[:, 1]), -1)


def centred_origin(outline: Outline, *, size_px: int = SIZE_PX, px_mm: float = PX_MM) -> Array:
    """The `origin_mm` that puts each mark's bounding box in the middle of the image, (B, 2)."""
    check_raster(size_px, px_mm)
    x = 0.5 * (outline.x_min_mm + outline.x_max_mm)
    middle = 0.5 * size_px * px_mm
    return np.stack((middle - x, np.full_like(x, middle)), -1)
