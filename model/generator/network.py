"""The neural generator: fully connected layers, then convolution with pixel shuffle (the paper's section III-B).

The paper gives no layer sizes. The network outputs not the coverage itself but a field: approximately the signed
distance to the stroke's boundary in pixels, positive inside, with coverage = clamp(1/2 + field, 0, 1). The field
changes smoothly with depth and tilt where coverage jumps, and pixels far from the boundary are exactly 0 or 1, so the
network spends no capacity on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from brushloop.model.protocol import ParameterSpec


class Inputs(nn.Module):
    """Scales P named inputs with ranges: (B, P) in their units to (B, P) in [-1, 1].

    The ranges are buffers, so that they move with the network to a device and into an exported file. An input whose
    range is a single point becomes 0.
    """

    low: Tensor
    span: Tensor

    def __init__(self, specs: tuple[ParameterSpec, ...]) -> None:
        super().__init__()
        self.specs = specs
        self.register_buffer("low", torch.tensor([spec.low for spec in specs]), persistent=False)
        widths = [spec.high - spec.low or 1.0 for spec in specs]
        self.register_buffer("span", torch.tensor(widths), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        """Scale to [-1, 1] without clamping: values outside the ranges are extrapolated by the polynomials."""
        return 2 * (values - self.low) / self.span - 1

    def check(self, values: Tensor) -> None:
        """Raise DomainError for the first value of (B, P) outside its range."""
        for k, spec in enumerate(self.specs):
            spec.check(values[:, k].detach())


def chebyshev(unit: Tensor, degree: int) -> Tensor:
    """T_0 to T_degree of numbers in [-1, 1], (...) -> (..., degree + 1), by T_k+1 = 2 x T_k - T_k-1."""
    terms = [torch.ones_like(unit), unit]
    for _ in range(degree - 1):
        terms.append(2 * unit * terms[-1] - terms[-2])
    return torch.stack(terms[: degree + 1], dim=-1)


@dataclass(frozen=True, slots=True)
class Layers:
    """Sizes of a network.

    `degree`: of the Chebyshev polynomials of each input. `width`, `depth`: of the fully connected layers. `channels`:
    of the `side` x `side` map that they output. `hidden_channels`: of a convolution between that map and the last
    convolution, 0 for none. `size_px`: of the image, a multiple of `side`.
    """

    degree: int = 4
    width: int = 256
    depth: int = 2
    channels: int = 16
    hidden_channels: int = 0
    side: int = 16
    size_px: int = 128

    def __post_init__(self) -> None:
        if self.size_px % self.side:
            raise ValueError(f"size_px = {self.size_px} is not a multiple of side = {self.side}")


class Generator(nn.Module):
    """Maps (B, P) inputs in their units to (B, size_px, size_px) coverage in [0, 1]."""

    def __init__(self, specs: tuple[ParameterSpec, ...], layers: Layers) -> None:
        super().__init__()
        self.layers = layers
        self.inputs = Inputs(specs)
        fully: list[nn.Module] = []
        size = layers.degree * len(specs)
        for _ in range(layers.depth):
            fully += [nn.Linear(size, layers.width), nn.SiLU()]
            size = layers.width
        fully.append(nn.Linear(size, layers.channels * layers.side**2))
        self.fully_connected = nn.Sequential(*fully)
        upscale = layers.size_px // layers.side
        convolution: list[nn.Module] = []
        channels = layers.channels
        if layers.hidden_channels:
            convolution += [nn.Conv2d(channels, layers.hidden_channels, 3, padding=1), nn.SiLU()]
            channels = layers.hidden_channels
        convolution += [nn.Conv2d(channels, upscale**2, 3, padding=1), nn.PixelShuffle(upscale)]
        self.convolution = nn.Sequential(*convolution)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]

    def field(self, values: Tensor) -> Tensor:
        """The field, approximately the signed distance in pixels, (B, P) -> (B, size_px, size_px)."""
        layers = self.layers
        terms = chebyshev(self.inputs(values), layers.degree)[..., 1:].flatten(1)
        map_ = self.fully_connected(terms).unflatten(1, (layers.channels, layers.side, layers.side))
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
