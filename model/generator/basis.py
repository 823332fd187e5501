"""The field basis: an interpolator fitted by least squares, an alternative to the network.

A field is expanded in products of Chebyshev polynomials of the inputs, with one image of coefficients per product;
the coverage is clamp(1/2 + field, 0, 1) as in the network. The fit uses no gradient descent: samples are taken at the
zeros of Chebyshev polynomials, where a fit of that degree is best conditioned; the first field is the signed distance
to the stroke; then the residual of the coverage is fitted and added repeatedly. Each such step lowers a convex bound
of the misfit (see `model.generator.network`). The number of terms is the product over the inputs, so this suits one
to three inputs; use a network for more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from model.generator.network import Inputs, chebyshev, covered, nodes
from model.generator.targets import Target
from model.protocol import ParameterSpec

MAX_TERMS = 512
_POINTS = 256  # points on an outline, to compute the distance to it


class FieldBasis(nn.Module):
    """Map (B, P) inputs in their own units to (B, N, N) coverage; `coefficients` (terms, N, N)."""

    coefficients: Tensor

    def __init__(self, specs: tuple[ParameterSpec, ...], degrees: Sequence[int], size_px: int) -> None:
        super().__init__()
        if len(degrees) != len(specs):
            raise ValueError(f"{len(degrees)} degrees for {len(specs)} inputs")
        self.degrees = tuple(degrees)
        self.inputs = Inputs(specs)
        terms = int(np.prod([degree + 1 for degree in degrees]))
        if not 0 < terms <= MAX_TERMS:
            raise ValueError(f"{terms} products of polynomials: at most {MAX_TERMS}; train a network instead")
        self.register_buffer("coefficients", torch.zeros(terms, size_px, size_px))

    def terms(self, values: Tensor) -> Tensor:
        """The products of polynomials, (B, P) -> (B, terms)."""
        unit = self.inputs(values)
        product = torch.ones_like(unit[:, :1])
        for k, degree in enumerate(self.degrees):
            product = (product.unsqueeze(-1) * chebyshev(unit[:, k], degree).unsqueeze(1)).flatten(1)
        return product

    def field(self, values: Tensor) -> Tensor:
        """The field, roughly the signed distance in pixels, (B, N, N)."""
        return (self.terms(values) @ self.coefficients.flatten(1)).unflatten(1, self.coefficients.shape[1:])

    def forward(self, values: Tensor) -> Tensor:
        """Coverage; differentiable in the values."""
        return covered(self.field(values))


def fit_basis(target: Target, degrees: Sequence[int] = (7, 2), samples: int = 768, rounds: int = 45) -> FieldBasis:
    """Fit the basis to a target; deterministic, without random numbers.

    Raises ValueError if the number of degrees differs from that of inputs or there are too many terms, and
    DomainError if the target has no shape at a sample.
    """
    basis = FieldBasis(target.inputs, degrees, target.size_px)
    start = _between(target, torch.cartesian_prod(*(nodes(degree + 1) for degree in degrees)).reshape(-1, len(degrees)))
    field = signed_distance(target, start)
    coefficients = torch.linalg.pinv(basis.terms(start).double()).float() @ field.flatten(1)
    # The boundary moves by several pixels between nodes, so refinement needs more samples than the start.
    spread = torch.quasirandom.SobolEngine(len(degrees)).draw(samples, dtype=torch.float64)
    inputs = _between(target, torch.cos(torch.pi * spread))
    wanted = target.images(inputs).flatten(1)
    design = basis.terms(inputs)
    inverse = torch.linalg.pinv(design.double()).float()
    for _ in range(rounds):
        coefficients += inverse @ (design @ coefficients).add_(0.5).clamp_(0, 1).sub_(wanted).neg_()
    basis.coefficients.copy_(coefficients.unflatten(1, basis.coefficients.shape[1:]))
    return basis


def signed_distance(target: Target, inputs: Tensor) -> Tensor:
    """The distance of pixel centres to the boundary in pixels, positive inside, (B, P) -> (B, N, N) float32."""
    shape = target.shape(inputs)
    outline = shape.outline()
    points = outline.polyline(-(-_POINTS // outline.weights.shape[1]))
    origin = target.origin_mm(inputs, shape)
    points = torch.stack((origin[:, :1] + points[..., 0], origin[:, 1:] - points[..., 1]), dim=-1) / target.px_mm
    along = points.roll(-1, 1) - points.roll(1, 1)
    step = torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    along = along / step.clamp(min=1e-9)
    centres = torch.arange(target.size_px, dtype=points.dtype) + 0.5
    pixels = torch.stack(torch.meshgrid(centres, centres, indexing="xy"), dim=-1).reshape(-1, 2)
    fields: list[Tensor] = []
    for place, tangent, length, image in zip(points, along, step[..., 0], target.images(inputs), strict=True):
        nearest = ((place**2).sum(-1) - 2 * (pixels @ place.T)).argmin(-1)
        offset = pixels - place[nearest]
        # Near a point the boundary follows its tangent.
        run = (offset * tangent[nearest]).sum(-1)
        run = torch.minimum(run.abs(), 0.25 * length[nearest]) * run.sign()
        distance = torch.linalg.vector_norm(offset - run[:, None] * tangent[nearest], dim=-1)
        fields.append(torch.where(image.flatten() > 0.5, distance, -distance).float())
    return torch.stack(fields).unflatten(1, (target.size_px, target.size_px))


def _between(target: Target, unit: Tensor) -> Tensor:
    """Map positions in [-1, 1] to inputs within their ranges, (B, P)."""
    low = torch.tensor([spec.low for spec in target.inputs], dtype=torch.float64)
    span = torch.tensor([spec.high - spec.low for spec in target.inputs], dtype=torch.float64)
    return (low + span * (unit + 1) / 2).float()
