"""Training targets of a generator: a stroke model's exact coverage over ranges of its parameters, in one placement."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import torch
from torch import Tensor

from brushloop.model.brush import Brush, DomainError
from brushloop.model.generator.network import Layers
from brushloop.model.outline import Shape
from brushloop.model.press_images import press_images
from brushloop.model.protocol import ParameterSpec, StrokeModel
from brushloop.model.raster.compiled import coverage_numpy
from brushloop.model.raster.frame import SIZE_PX, centred_origin

ANCHOR_SHARE = (0.76, 0.5)
"""Position of the zero-touch point in the image, from the left and the top, as in the validation's mm field."""
_BLOCK = 64  # candidates tried at a time


class Placement(StrEnum):
    """How a stroke is put into the image, at heading 0."""

    CENTRED = "centred"
    """Bounding box centred: the longest press of the paper's grid just fits at 0.2 mm/px."""
    ZERO_TOUCH = "zero-touch"
    """The zero-touch point at ANCHOR_SHARE; O3 lies H tan(alpha) from it. Needs depth_mm and tilt_deg."""
    BASE = "base"
    """O3 at (base_x_mm, base_y_mm) from the left and the top: the paper's (x0, y0), fixed or inputs."""


BASE_SPECS = (
    ParameterSpec("base_x_mm", "mm", -400, 400, 29.2, "x0, O3 from the image's left edge"),
    ParameterSpec("base_y_mm", "mm", -400, 400, 19.2, "y0, O3 from the image's top edge"),
)
"""The paper's starting point (x0, y0). Not called x0_mm, the name of a QBC's first control point."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A stroke model, the ranges of the inputs, the fixed parameters, and the placement of strokes.

    `inputs` carry the trained ranges as low and high. Raises ValueError for an unknown parameter, a range outside
    the model's, or a placement whose parameters are missing.
    """

    model: StrokeModel
    ranges: Mapping[str, tuple[float, float]]
    fixed: Mapping[str, float] = field(default_factory=dict[str, float])
    placement: Placement = Placement.CENTRED
    px_mm: float = 0.2
    size_px: int = SIZE_PX
    inputs: tuple[ParameterSpec, ...] = field(init=False)

    def __post_init__(self) -> None:
        known = {spec.name: spec for spec in self.model.parameters}
        if self.placement is Placement.BASE:
            known |= {spec.name: spec for spec in BASE_SPECS}
        if self.placement is Placement.ZERO_TOUCH and not {"depth_mm", "tilt_deg"} <= known.keys():
            raise ValueError(f"placement zero-touch needs depth_mm and tilt_deg, which {self.model.name} does not have")
        if not self.ranges:
            raise ValueError("ranges is empty: a generator needs an input")
        specs: list[ParameterSpec] = []
        for name, (low, high) in self.ranges.items():
            if name not in known:
                raise ValueError(f"ranges.{name}: {self.model.name} knows {', '.join(known)}")
            spec = known[name]
            if not spec.low <= low < high <= spec.high:
                raise ValueError(f"ranges.{name} = [{low:g}, {high:g}] must grow within [{spec.low:g}, {spec.high:g}]")
            default = min(max(spec.default, low), high)
            specs.append(replace(spec, low=low, high=high, default=default))
        for name, value in self.fixed.items():
            if name not in known or name in self.ranges:
                raise ValueError(f"fixed.{name}: not a parameter that is left to fix")
            if not known[name].low <= value <= known[name].high:
                raise ValueError(f"fixed.{name} = {value:g} is outside [{known[name].low:g}, {known[name].high:g}]")
        object.__setattr__(self, "inputs", tuple(specs))

    def values(self, inputs: Tensor) -> dict[str, Tensor]:
        """(N, P) inputs as the model's named parameters and the base, in float64, each (N,)."""
        wide = inputs.detach().double().cpu()
        named = {spec.name: wide[:, k] for k, spec in enumerate(self.inputs)}
        rest = self.model.parameters + (BASE_SPECS if self.placement is Placement.BASE else ())
        fixed = {spec.name: self.fixed.get(spec.name, spec.default) for spec in rest if spec.name not in named}
        return named | {name: torch.full((len(wide),), value, dtype=torch.float64) for name, value in fixed.items()}

    def shape(self, inputs: Tensor) -> Shape:
        """The exact shapes of (N, P) inputs; may raise DomainError."""
        values = self.values(inputs)
        return self.model.shape({spec.name: values[spec.name] for spec in self.model.parameters})

    def origin_mm(self, inputs: Tensor, shape: Shape | None = None) -> Tensor:
        """Where O3 lies in each image, (N, 2) from the left and the top; `shape` saves making the shapes again."""
        values = self.values(inputs)
        match self.placement:
            case Placement.CENTRED:
                return centred_origin(shape or self.shape(inputs), size_px=self.size_px, px_mm=self.px_mm)
            case Placement.ZERO_TOUCH:
                side_mm = self.size_px * self.px_mm
                x = ANCHOR_SHARE[0] * side_mm + values["depth_mm"] * torch.tan(values["tilt_deg"] * (math.pi / 180))
                return torch.stack((x, torch.full_like(x, ANCHOR_SHARE[1] * side_mm)), dim=-1)
            case Placement.BASE:
                return torch.stack((values["base_x_mm"], values["base_y_mm"]), dim=-1)

    def images(self, inputs: Tensor, threads: int = 1) -> Tensor:
        """Exact coverage of (N, P) inputs, (N, size_px, size_px) float32 on the CPU; may raise DomainError."""
        if self.model.name == "ccd-bsm":
            return self._press_images(inputs, threads)
        shape = self.shape(inputs)
        origin = self.origin_mm(inputs, shape)
        images = coverage_numpy(shape, origin, size_px=self.size_px, px_mm=self.px_mm, threads=threads)
        return torch.from_numpy(images)

    def _press_images(self, inputs: Tensor, threads: int) -> Tensor:
        """The images of CCD-BSM, for which there is a quicker raster."""
        values = self.values(inputs)
        images = press_images(
            Brush(values["radius_mm"], values["length_mm"]),
            values["depth_mm"].numpy(),
            values["tilt_deg"].numpy(),
            values["lam"].numpy(),
            origin_mm=None if self.placement is Placement.CENTRED else self.origin_mm(inputs).numpy(),
            size_px=self.size_px,
            px_mm=self.px_mm,
            threads=threads,
        )
        return torch.from_numpy(images)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`count` inputs drawn uniformly from the ranges, without those that the model rejects, (count, P) float32.

        Raises ValueError if the model rejects more than nine in ten.
        """
        low = torch.tensor([spec.low for spec in self.inputs])
        span = torch.tensor([spec.high - spec.low for spec in self.inputs])
        found: list[Tensor] = []
        have = tried = 0
        while have < count:
            candidates = low + span * torch.rand((_BLOCK, len(self.inputs)), generator=generator)
            good = candidates[self._accepted(candidates)]
            found.append(good)
            have, tried = have + len(good), tried + _BLOCK
            if tried >= 20 * _BLOCK and have < tried / 10:
                raise ValueError(f"{self.model.name} refuses nine of ten strokes in these ranges")
        return torch.cat(found)[:count]

    def _accepted(self, inputs: Tensor) -> Tensor:
        """Whether the model accepts each input, (N,) bool; halves rejected batches until the bad inputs are found."""
        try:
            self.shape(inputs)
        except DomainError:
            if len(inputs) == 1:
                return torch.zeros(1, dtype=torch.bool)
            half = len(inputs) // 2
            return torch.cat((self._accepted(inputs[:half]), self._accepted(inputs[half:])))
        return torch.ones(len(inputs), dtype=torch.bool)


_PRESS = {"depth_mm": (11.0, 20.0), "tilt_deg": (0.0, 10.0)}
"""The paper's ranges of H and alpha."""


@dataclass(frozen=True, slots=True)
class Preset:
    """Defaults of a target, with a suitable network."""

    model: str
    ranges: dict[str, tuple[float, float]]
    placement: Placement
    px_mm: float
    layers: Layers
    fixed: dict[str, float] = field(default_factory=dict[str, float])
    rate: float = 3e-3
    """Learning rate."""


PRESETS: dict[str, Preset] = {
    "press": Preset("ccd-bsm", _PRESS, Placement.CENTRED, 0.2, Layers(), rate=5e-3),
    "anchored": Preset("ccd-bsm", _PRESS, Placement.ZERO_TOUCH, 0.3, Layers(), rate=5e-3),
    "all": Preset(
        "ccd-bsm",
        {
            "length_mm": (44.0, 52.0),
            "radius_mm": (5.0, 7.0),
            **_PRESS,
            "base_x_mm": (26.0, 32.0),
            "base_y_mm": (16.2, 22.2),
        },
        Placement.BASE,
        0.3,
        Layers(width=384, depth=3, channels=32, hidden_channels=64),
    ),
    "qbc": Preset(
        "qbc",
        {
            "x0_mm": (-17.0, -12.0),
            "y0_mm": (-7.8, 7.8),
            "x1_mm": (-11.0, -3.4),
            "y1_mm": (-7.8, 7.8),
            "x2_mm": (-2.4, 2.6),
            "y2_mm": (-7.8, 7.8),
            "start_width_mm": (1.0, 5.0),
            "end_width_mm": (1.0, 5.0),
        },
        Placement.BASE,
        0.2,
        Layers(width=384, depth=3, channels=32, hidden_channels=64),
        {"base_x_mm": 20.0, "base_y_mm": 12.8},
    ),
    "bezier": Preset(
        "bezier",
        {"tip_mm": (11.0, 22.0), "base_mm": (1.0, 2.6), "belly_mm": (8.0, 16.0), "shoulder": (0.2, 0.9)},
        Placement.CENTRED,
        0.2,
        Layers(),
    ),
}
"""`press`: (H, alpha), as the paper's section IV-B. `all`: the paper's M = {L, R, H, alpha} and (x0, y0).
`anchored`: (H, alpha) on the validation's millimetre field. `qbc`, `bezier`: the ablation of its figure 12."""
