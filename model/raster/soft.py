"""A soft raster: exact coverage seen through a Gaussian, so that a pixel off the boundary feels it too.

The image is the convolution of the exact coverage with a sampled Gaussian of `softness_px`. It keeps the amount of
ink, tends to the exact image as the softness goes to 0, and its gradient reaches about three softnesses to either
side of the boundary, which is what a fit that starts a few pixels off needs. Everything that `coverage_at` is
differentiable in, it is differentiable in: (H, alpha, L, R, lambda) through the shape, x0, y0 and heading.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from model.profile import Shape
from model.raster.exact import coverage_at
from model.raster.frame import PX_MM, SIZE_PX, Place, check_raster, place

_REACH = 4.0  # where the Gaussian is cut off, in softnesses: 6e-5 of it lies beyond


def soft_coverage(
    shape: Shape,
    origin_mm: Place,
    heading_deg: float | Tensor = 0.0,
    *,
    softness_px: float = 1.0,
    size_px: int = SIZE_PX,
    px_mm: float = PX_MM,
) -> Tensor:
    """Blurred coverage, (B, size_px, size_px) in [0, 1]; arguments as in `coverage_at`.

    `softness_px` is the standard deviation of the blur. Ink just outside the image counts as it should. Raises
    ValueError unless 0 < softness_px < inf, and as `coverage_at`.
    """
    check_raster(size_px, px_mm)
    if not 0 < softness_px < math.inf:
        raise ValueError(f"softness_px = {softness_px:g} is outside (0, inf); for 0 use coverage_at")
    margin = math.ceil(_REACH * softness_px)
    origin = place(origin_mm, shape.x_min_mm) + margin * px_mm
    image = coverage_at(shape, origin, heading_deg, size_px=size_px + 2 * margin, px_mm=px_mm)
    offset = torch.arange(-margin, margin + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-0.5 * (offset / softness_px) ** 2)
    kernel = kernel / kernel.sum()
    # Along the columns, then along the rows: a Gaussian is the product of the two.
    image = torch.nn.functional.conv2d(image[:, None], kernel[None, None, :, None])
    return torch.nn.functional.conv2d(image, kernel[None, None, None, :])[:, 0]
