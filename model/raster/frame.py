"""The definition of position, heading and pixel that all code uses; illustrated in `docs/models.md`.

Stroke frame: x along the stroke axis, positive toward the belly, heel and ferrule; y to the left of +x; the origin
is O3, where the brush axis meets the paper. Lengths are mm.
Image: square; the column grows to the right, the row downwards. Pixel (i, j) is the square between row edges i and
i + 1 and column edges j and j + 1, so its centre is (i + 1/2, j + 1/2) pixels from the top left corner.
`origin_mm` is where O3 lies in the image: (mm from the left edge, mm from the top edge). `heading_deg` is where +x
points: 0 is to the right, 90 up, counter-clockwise. A point (x, y) of the stroke lies at
    column = (origin_x + x cos(heading) - y sin(heading)) / px,
    row    = (origin_y - x sin(heading) - y cos(heading)) / px.
"""

from __future__ import annotations

import torch
from torch import Tensor

from brushloop.model.outline import Shape

SIZE_PX = 128
PX_MM = 0.2
Place = Tensor | tuple[float, float]


def check_raster(size_px: int, px_mm: float) -> None:
    """Raise ValueError unless the raster has pixels of a positive size."""
    if size_px < 1 or not px_mm > 0:
        raise ValueError(f"size_px = {size_px}, px_mm = {px_mm:g}: both must be positive")


def place(origin_mm: Place, like: Tensor) -> Tensor:
    """`origin_mm` as (B, 2) of the dtype and device of `like`, whose first dimension is B; else ValueError."""
    origin = torch.as_tensor(origin_mm, dtype=like.dtype, device=like.device)
    if origin.shape not in ((2,), (len(like), 2)):
        raise ValueError(f"origin_mm has shape {tuple(origin.shape)}, expected (2,) or ({len(like)}, 2)")
    return origin.expand(len(like), 2)


def turn(heading_deg: float | Tensor, like: Tensor) -> Tensor:
    """`heading_deg` as (B,) of the dtype and device of `like`; else ValueError."""
    heading = torch.as_tensor(heading_deg, dtype=like.dtype, device=like.device)
    if heading.shape not in ((), (1,), (len(like),)):
        raise ValueError(f"heading_deg has shape {tuple(heading.shape)}, expected a scalar or ({len(like)},)")
    return heading.expand(len(like))


def to_pixels(origin_mm: Place, heading_deg: float | Tensor, px_mm: float, like: Tensor) -> Tensor:
    """The map of the module's last two lines as (B, 6): column = m0 x + m1 y + m2, row = m3 x + m4 y + m5."""
    origin, heading = place(origin_mm, like) / px_mm, torch.deg2rad(turn(heading_deg, like))
    cosine, sine = torch.cos(heading) / px_mm, torch.sin(heading) / px_mm
    return torch.stack((cosine, -sine, origin[:, 0], -sine, -cosine, origin[:, 1]), dim=-1)


def centred_origin(shape: Shape, *, size_px: int = SIZE_PX, px_mm: float = PX_MM) -> Tensor:
    """The `origin_mm` that puts each shape's bounding box in the middle of the image, (B, 2)."""
    check_raster(size_px, px_mm)
    middle = torch.full_like(shape.x_min_mm, 0.5 * size_px * px_mm)
    return torch.stack((middle - 0.5 * (shape.x_min_mm + shape.x_max_mm), middle), dim=-1)
