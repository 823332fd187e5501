"""The neural generator: fully connected layers, then convolution with pixel shuffle (the paper's section III-B).

The paper gives no layer sizes. What is drawn here is not the coverage itself but a field: its value is about the
signed distance to the stroke's boundary in pixels, positive inside, and coverage = clamp(1/2 + field, 0, 1). A field
changes smoothly with depth and tilt where coverage jumps, and pixels far from the boundary are exactly 0 or 1, so the
network spends nothing on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from model.generator.features import Inputs, chebyshev
from model.protocol import ParameterSpec


@dataclass(frozen=True, slots=True)
class Layers:
    """Sizes of a network.

    `degree`: Chebyshev polynomials of each input. `width`, `depth`: fully connected layers. `channels`: of the
    `side` x `side` map that they end in. `hidden_channels`: of a convolution between the map and the last one, 0
    for none. `size_px`: the image, a multiple of `side`.
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
            raise ValueError(f"size_px = {self.size_px} is no multiple of side = {self.side}")


class Generator(nn.Module):
    """(B, P) inputs in their own units to (B, size_px, size_px) coverage in [0, 1]."""

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
        """The field, about the signed distance in pixels, (B, P) -> (B, size_px, size_px)."""
        layers = self.layers
        terms = chebyshev(self.inputs(values), layers.degree)[..., 1:].flatten(1)
        map_ = self.fully_connected(terms).unflatten(1, (layers.channels, layers.side, layers.side))
        return self.convolution(map_).squeeze(1)

    def forward(self, values: Tensor) -> Tensor:
        """Coverage, clamp(1/2 + field, 0, 1); differentiable in the values."""
        return covered(self.field(values))


def covered(field: Tensor) -> Tensor:
    """The coverage that a field stands for, any shape."""
    return (field + 0.5).clamp(0, 1)


def parameter_count(module: nn.Module) -> int:
    """How many numbers are trained."""
    return sum(parameter.numel() for parameter in module.parameters())
