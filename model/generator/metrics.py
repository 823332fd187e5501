"""How close drawn images are to their targets, over a whole set."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

SSIM_SETTINGS = "scikit-image, data_range 1, gaussian weights, sigma 1.5, population covariance"


@dataclass(frozen=True, slots=True)
class Quality:
    """Means over `images` images, and the worst SSIM. Ink is 1, paper 0; IoU counts the pixels that are mostly ink."""

    images: int
    mse: float
    iou: float
    csim: float
    ssim: float
    ssim_min: float

    @property
    def psnr_db(self) -> float:
        """10 log10(1 / MSE), for images in [0, 1]; infinite for equal images."""
        return 10 * math.log10(1 / self.mse) if self.mse else math.inf


def quality(pairs: Iterable[tuple[Tensor, Tensor]]) -> Quality:
    """Compare (drawn, target) batches, each (B, N, N) in [0, 1]. SSIM takes some milliseconds per image.

    Raises ValueError if there are no images.
    """
    errors: list[Tensor] = []
    overlaps: list[Tensor] = []
    cosines: list[Tensor] = []
    structures: list[float] = []
    for drawn, target in pairs:
        a, b = drawn.detach().double().flatten(1), target.double().flatten(1)
        errors.append((a - b).square().mean(-1))
        ink, wanted = a > 0.5, b > 0.5
        overlaps.append((ink & wanted).sum(-1).double() / (ink | wanted).sum(-1).clamp(min=1))
        cosines.append((a * b).sum(-1) / (a.norm(dim=-1) * b.norm(dim=-1)).clamp(min=1e-12))
        structures += [_ssim(x.double().numpy(), y.double().numpy()) for x, y in zip(drawn, target, strict=True)]
    if not errors:
        raise ValueError("no images to compare")
    mse, iou, csim = (float(torch.cat(parts).mean()) for parts in (errors, overlaps, cosines))
    return Quality(len(structures), mse, iou, csim, sum(structures) / len(structures), min(structures))


def _ssim(drawn: Any, target: Any) -> float:
    """Mean structural similarity with `SSIM_SETTINGS`."""
    import skimage.metrics

    untyped: Any = skimage.metrics
    value = untyped.structural_similarity(
        drawn, target, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return float(value)
