"""Named inputs of a generator, and the polynomials of them that both the network and the field basis start from."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.protocol import ParameterSpec


class Inputs(nn.Module):
    """P named inputs with ranges: (B, P) in their own units to (B, P) in [-1, 1].

    The ranges are buffers, so that they follow the network to a device and into an exported file. An input whose
    range is one point becomes 0.
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
        """To [-1, 1]; nothing is clamped, so whoever asks outside the ranges gets what the polynomials say."""
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


def nodes(degree: int) -> Tensor:
    """The zeros of T_(degree + 1): where polynomials of that degree are best sampled, (degree + 1,) in (-1, 1)."""
    k = torch.arange(degree + 1, dtype=torch.float64)
    return torch.cos(torch.pi * (k + 0.5) / (degree + 1))
