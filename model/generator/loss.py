"""Eq. 6 of the paper, the weighted mean squared error, with a gradient that also passes where the clamp is flat.

A field that is far on the wrong side of the boundary has no gradient through clamp(1/2 + field). The gradient used
here is w (clamp(1/2 + field) - target), the residual itself: that of the convex function whose derivative the clamp
is, as cross-entropy is to the sigmoid. It is zero exactly where Eq. 6 is, and equals Eq. 6's own between 0 and 1.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _WeightedError(torch.autograd.Function):
    """The sum of w (clamp(1/2 + field) - target)^2; one pass over the images each way."""

    @staticmethod
    def forward(ctx: Any, field: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        error = field.add(0.5).clamp_(0, 1).sub_(target)
        weighted = error if weights is None else error * weights
        ctx.save_for_backward(weighted)
        return (error * weighted).sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (weighted,) = ctx.saved_tensors
        return weighted * (2 * grad), None, None


def squared_error(field: Tensor, target: Tensor, ink_weight: float = 1.0) -> Tensor:
    """The sum over all pixels of w (coverage - target)^2 with w = 1 + (ink_weight - 1) target, a scalar.

    `field` and `target` (B, N, N). Divide by the number of pixels of the whole batch for Eq. 6.
    """
    weights = None if ink_weight == 1.0 else 1 + (ink_weight - 1) * target
    total = _WeightedError.apply(field, target, weights)
    assert isinstance(total, Tensor)
    return total
