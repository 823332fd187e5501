"""A generator as a stroke model: its image, traced to a shape that can be turned, scaled and compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from brushloop.model.brush import DomainError
from brushloop.model.ccdbsm import as_batch
from brushloop.model.generator.network import Generator
from brushloop.model.generator.targets import Placement, Target
from brushloop.model.outline import Outline
from brushloop.model.protocol import Number, ParameterSpec, Values


@dataclass(frozen=True, slots=True, eq=False)
class GeneratorModel:
    """A `StrokeModel` drawn by a trained generator; `fitted` if it was tuned on captures.

    The parameters are the generator's inputs with their trained ranges; a base that is an input only positions
    the stroke and is not one of them. `shape` is the outline at half coverage of the drawn image, traced between
    pixel centres, so it carries no gradient and its tip ends where the stroke is half a pixel wide; `images` are the
    network's output, and are differentiable.
    """

    name: str
    label: str
    definition: str
    network: Generator
    target: Target
    fitted: bool = False

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """See `StrokeModel.parameters`."""
        return tuple(spec for spec in self.network.inputs.specs if not spec.name.startswith("base_"))

    def images(self, values: Mapping[str, Number]) -> Tensor:
        """The network's images in its trained placement and scale, (B, N, N); see `StrokeModel.shape` for errors."""
        return self.network(self._inputs(values))

    def shape(self, values: Mapping[str, Number]) -> Outline:
        """See `StrokeModel.shape`; also raises ValueError if the generator draws no ink."""
        inputs = self._inputs(values)
        with torch.no_grad():
            drawn = self.network(inputs)
        origin = self.target.origin_mm(inputs)
        return traced(drawn, origin, self.target.px_mm)

    def of_press(self, depth_mm: Number, tilt_deg: Number) -> Values:
        """See `StrokeModel.of_press`; DomainError outside the trained ranges or if a fixed parameter differs.

        A parameter that was fixed in training must have the value that the stroke model gives this press.
        """
        values = self.target.model.of_press(depth_mm, tilt_deg)
        trained = {spec.name for spec in self.network.inputs.specs}
        fixed = {spec.name: self.target.fixed.get(spec.name, spec.default) for spec in self.target.model.parameters}
        for name in fixed.keys() - trained:
            off = (values[name] - fixed[name]).abs() > 1e-6 * abs(fixed[name])
            if off.any():
                raise DomainError(name, float(values[name][off][0]), f"the {fixed[name]:g} it was trained with")
        return {name: value for name, value in values.items() if name in trained}

    def profile(self, depth_mm: Number, tilt_deg: Number) -> Outline:
        """See `StrokeModel.profile`."""
        return self.shape(self.of_press(depth_mm, tilt_deg))

    def _inputs(self, values: Mapping[str, Number]) -> Tensor:
        """The inputs by name as (B, P) float32, checked."""
        specs = self.network.inputs.specs
        unknown = values.keys() - {spec.name for spec in specs}
        if unknown:
            raise ValueError(f"{self.name} has no parameter {sorted(unknown)[0]!r}")
        batch = as_batch(*(values.get(spec.name, spec.default) for spec in specs))
        for spec, value in zip(specs, batch, strict=True):
            spec.check(value.detach())
        return torch.stack([value.to(torch.float32) for value in batch], dim=-1)


def generator_model(network: Generator, target: Target, *, fitted: bool = False) -> GeneratorModel:
    """A trained network as a stroke model called `<model>-generator`; CCD-BSM's is the paper's CCD-BSMG."""
    ccd = target.model.name == "ccd-bsm"
    tuned = ", then tuned on captured strokes" if fitted else ""
    base = "" if target.placement is not Placement.BASE else " at a base point"
    return GeneratorModel(
        name="ccd-bsmg" if ccd else f"{target.model.name}-generator",
        label="CCD-BSMG" if ccd else f"{target.model.label} generator",
        definition=f"A network trained on exact images of {target.model.label}{base}{tuned}; its outline is traced at "
        f"half coverage.",
        network=network,
        target=target,
        fitted=fitted or target.model.fitted,
    )


def traced(images: Tensor, origin_mm: Tensor, px_mm: float) -> Outline:
    """The longest contour at half coverage of each image, (B, N, N) and (B, 2), as straight arcs in mm.

    Raises ValueError for an image without ink.
    """
    import skimage.measure

    untyped: Any = skimage.measure
    polygons: list[Tensor] = []
    for image, origin in zip(images.cpu().double().numpy(), origin_mm, strict=True):
        contours = untyped.find_contours(np.pad(image, 1), 0.5)
        if not contours:
            raise ValueError("the generator draws no ink for these parameters")
        rows, columns = max(contours, key=len)[:-1].T - 0.5  # a pixel's centre is at + 1/2; the padding shifts by 1
        x, y = columns * px_mm - float(origin[0]), float(origin[1]) - rows * px_mm
        if np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1)):
            x, y = x[::-1], y[::-1]
        polygons.append(torch.from_numpy(np.stack((x, y), axis=-1)))
    most = max(map(len, polygons))
    # Zero-length arcs at the end give all outlines the same number of arcs.
    ends = torch.stack([torch.cat((p, p[:1].expand(most + 1 - len(p), 2))) for p in polygons])
    start, end = ends[:, :-1], ends[:, 1:]
    points = torch.stack((start, 0.5 * (start + end), end), dim=2)
    return Outline(points, torch.ones(points.shape[:2], dtype=points.dtype))
