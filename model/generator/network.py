"""The network of the generator (CCD-BSMG) in torch, and its loss, Eq. 6 of the paper.

The network is fully connected layers, then convolution with pixel shuffle (the paper's section III-B, which gives no
layer sizes). It outputs not the coverage itself but a field: approximately the signed distance to the stroke's boundary
in pixels, positive inside, with coverage = clamp(1/2 + field, 0, 1). The field changes smoothly with depth and tilt
where coverage jumps, and pixels far from the boundary are exactly 0 or 1, so the network spends no capacity on them.
`model.generator.stroke` computes the same images in numpy.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from brushloop.model.generator.config import INPUTS, Layers, Target


class Generator(nn.Module):
    """Maps (B, 2) depths in mm and tilts in deg to (B, size_px, size_px) coverage in [0, 1]."""

    low: Tensor
    high: Tensor

    def __init__(self, target: Target, layers: Layers) -> None:
        super().__init__()
        self.layers = layers
        # Buffers, so that the ranges move with the network to a device.
        ranges = torch.tensor([getattr(target, name) for name in INPUTS])
        self.register_buffer("low", ranges[:, 0], persistent=False)
        self.register_buffer("high", ranges[:, 1], persistent=False)
        fully: list[nn.Module] = []
        size = layers.degree * len(INPUTS)
        for _ in range(layers.depth):
            fully += [nn.Linear(size, layers.width), nn.SiLU()]
            size = layers.width
        fully.append(nn.Linear(size, layers.channels * layers.side**2))
        self.fully_connected = nn.Sequential(*fully)
        upscale = target.size_px // layers.side
        convolution = nn.Conv2d(layers.channels, upscale**2, 3, padding=1)
        self.convolution = nn.Sequential(convolution, nn.PixelShuffle(upscale))
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]

    def field(self, values: Tensor) -> Tensor:
        """The field, approximately the signed distance in pixels, (B, 2) -> (B, size_px, size_px).

        Values outside the ranges are extrapolated by the polynomials.
        """
        layers = self.layers
        unit = 2 * (values - self.low) / (self.high - self.low) - 1
        terms = [torch.ones_like(unit), unit]
        for _ in range(layers.degree - 1):  # Chebyshev polynomials: T_k+1 = 2 x T_k - T_k-1
            terms.append(2 * unit * terms[-1] - terms[-2])
        inputs = torch.stack(terms[1 : layers.degree + 1], dim=-1).flatten(1)
        map_ = self.fully_connected(inputs).unflatten(1, (layers.channels, layers.side, layers.side))
        return self.convolution(map_).squeeze(1)

    def forward(self, values: Tensor) -> Tensor:
        """Coverage, clamp(1/2 + field, 0, 1); differentiable in the values."""
        return covered(self.field(values))


def covered(field: Tensor) -> Tensor:
    """The coverage of a field, any shape."""
    return (field + 0.5).clamp(0, 1)


class _WeightedError(torch.autograd.Function):
    """Sum of w (clamp(1/2 + field) - target)^2, with a gradient that also passes where the clamp is flat.

    A field that is far on the wrong side of the boundary has no gradient through clamp(1/2 + field). The gradient used
    here is the residual w (clamp(1/2 + field) - target): that of the convex function whose derivative is the clamp,
    as cross-entropy relates to the sigmoid. It is zero exactly where Eq. 6 is, and equals the gradient of Eq. 6
    between 0 and 1. One pass over the images in each direction.
    """

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
    """Eq. 6 of the paper: the sum over all pixels of w (coverage - target)^2, w = 1 + (ink_weight - 1) target.

    `field` and `target` are (B, N, N). Divide by the number of pixels of the whole batch for Eq. 6.
    """
    weights = None if ink_weight == 1.0 else 1 + (ink_weight - 1) * target
    total = _WeightedError.apply(field, target, weights)
    assert isinstance(total, Tensor)
    return total
