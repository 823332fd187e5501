"""Configuration of a training, read from TOML: frozen, validated, and stored in every checkpoint."""

from __future__ import annotations

import math
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from brushloop.model.brush import Brush, DomainError
from brushloop.model.generator.network import Generator, Layers
from brushloop.model.generator.targets import PRESETS, Placement, Target
from brushloop.model.strokes import UnknownModelError, stroke_model
from brushloop.model.train.errors import TrainError

MAX_BYTES = 64 * 1024
MAX_WEIGHTS = 50_000_000
Range = tuple[float, float]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class LayerConfig(_Frozen):
    """Network sizes; see `model.generator.network.Layers`."""

    degree: Annotated[int, Field(ge=1, le=16)] = 4
    width: Annotated[int, Field(ge=1, le=2048)] = 256
    depth: Annotated[int, Field(ge=1, le=8)] = 2
    channels: Annotated[int, Field(ge=1, le=128)] = 16
    hidden_channels: Annotated[int, Field(ge=0, le=256)] = 0
    side: Literal[8, 16, 32, 64] = 16


class TargetConfig(_Frozen):
    """Strokes to draw; see `model.generator.targets.Target`."""

    model: Annotated[str, Field(max_length=64)] = "ccd-bsm"
    radius_mm: Annotated[float, Field(gt=0, le=100)] = 6.0
    length_mm: Annotated[float, Field(gt=0, le=400)] = 48.0
    lam: Annotated[float, Field(gt=0, le=10)] = math.pi
    fitted_brush: bool = False
    """Whether lambda or the brush was fitted to captures; if so, every report says it."""
    ranges: Annotated[dict[str, Range], Field(min_length=1, max_length=16)]
    fixed: Annotated[dict[str, float], Field(max_length=16)] = {}
    placement: Placement = Placement.CENTRED
    px_mm: Annotated[float, Field(ge=0.01, le=10)] = 0.2
    size_px: Literal[32, 64, 128, 256] = 128


class TuningConfig(_Frozen):
    """Fine-tuning on captured strokes: the initial generator and the captures, by content hash."""

    start_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    captures_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    source: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\r\n]*$")]
    """Origin of the captured ink, for example `loopback rig`."""
    held_out: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Share of captures used only for validation, never for training."""


class TrainConfig(_Frozen):
    """A whole training. The defaults are the paper's where it gives a number."""

    target: TargetConfig
    layers: LayerConfig = LayerConfig()
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    training_images: Annotated[int, Field(ge=1, le=1_000_000)] = 20_000
    validation_images: Annotated[int, Field(ge=1, le=1_000_000)] = 2_000
    batch: Annotated[int, Field(ge=1, le=4_096)] = 64
    """Images per step."""
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 6_000
    """G of Algorithm 1."""
    picture_every: Annotated[int, Field(ge=1)] = 1_000
    """m of Algorithm 1."""
    validate_every: Annotated[int, Field(ge=1)] = 250
    checkpoint_every: Annotated[int, Field(ge=1)] = 250
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 5e-3
    """Peak: the rate rises over `warmup_steps`, then falls along half a cosine to 0 at the last step."""
    warmup_steps: Annotated[int, Field(ge=0)] = 50
    ink_weight: Annotated[float, Field(ge=1, le=1000)] = 1.0
    """w of Eq. 6 where the target is ink; w is 1 where it is paper."""
    target_mse: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Converged when the validation MSE is at most this; 0 disables."""
    patience: Annotated[int, Field(ge=0)] = 0
    """Converged after this many validations in a row without a gain of 1 %; 0 disables."""
    blank_after: Annotated[int, Field(ge=1)] = 2
    """Number of validations in a row with blank output that ends the training."""
    tuning: TuningConfig | None = None
    """Origin of weights and images when training on captures."""
    threads: Annotated[int, Field(ge=1, le=256)] = 1
    """Threads of torch; a different number changes the last bits of the weights."""
    workers: Annotated[int, Field(ge=0, le=64)] = 1
    """Threads that draw batches ahead; 0 draws each when its step comes. Changes no image."""
    device: Literal["cpu", "cuda"] = "cpu"
    """The device that trains: the CPU, or the first NVIDIA GPU."""

    @model_validator(mode="after")
    def _build(self) -> TrainConfig:
        self.build_target()
        if self.target.size_px % self.layers.side:
            raise ValueError(f"layers.side = {self.layers.side} does not divide size_px = {self.target.size_px}")
        if self.weight_count() > MAX_WEIGHTS:
            raise ValueError(f"layers: {self.weight_count():,} weights; at most {MAX_WEIGHTS:,}")
        return self

    def weight_count(self) -> int:
        """Number of weights, without building the network."""
        n, upscale = self.layers, self.target.size_px // self.layers.side
        sizes = [n.degree * len(self.target.ranges), *[n.width] * n.depth, n.channels * n.side**2]
        fully = sum((a + 1) * b for a, b in pairwise(sizes))
        planes = [n.channels, *([n.hidden_channels] if n.hidden_channels else []), upscale**2]
        return fully + sum((9 * a + 1) * b for a, b in pairwise(planes))

    def build_target(self) -> Target:
        """Build the target. Raises ValueError if the fields are inconsistent."""
        t = self.target
        try:
            basis = stroke_model(t.model, Brush(t.radius_mm, t.length_mm), t.lam, fitted=t.fitted_brush)
        except (UnknownModelError, DomainError) as error:
            raise ValueError(str(error)) from error
        fixed = dict(t.fixed)
        own = {"radius_mm": t.radius_mm, "length_mm": t.length_mm, "lam": t.lam} if t.model == "ccd-bsm" else {}
        fixed = {name: value for name, value in own.items() if name not in t.ranges} | fixed
        return Target(basis, t.ranges, fixed, t.placement, t.px_mm, t.size_px)

    def build_network(self) -> Generator:
        """Build the network with the weights of `seed`, leaving the state of torch's random generator unchanged."""
        import torch

        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            return Generator(self.build_target().inputs, self.build_layers())

    def build_layers(self) -> Layers:
        """Build the network sizes."""
        return Layers(**self.layers.model_dump(), size_px=self.target.size_px)


def preset(name: str, **changes: Any) -> TrainConfig:
    """Make the configuration of a preset with fields changed. Raises TrainError for an unknown name or bad field."""
    if name not in PRESETS:
        raise TrainError(name, f"no such target; known: {', '.join(PRESETS)}")
    chosen = PRESETS[name]
    sizes = {field: getattr(chosen.layers, field) for field in LayerConfig.model_fields}
    target = {
        "model": chosen.model,
        "ranges": chosen.ranges,
        "fixed": chosen.fixed,
        "placement": chosen.placement,
        "px_mm": chosen.px_mm,
    }
    return checked(f"target {name}", {"target": target, "layers": sizes, "learning_rate": chosen.rate} | changes)


def load_config(path: Path) -> TrainConfig:
    """Read a TOML file. Raises TrainError with file, field and allowed values."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise TrainError(path, error.strerror or "cannot be read") from error
    if len(data) > MAX_BYTES:
        raise TrainError(path, f"is larger than {MAX_BYTES} bytes")
    try:
        return checked(path, tomllib.loads(data.decode("utf-8")))
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        raise TrainError(path, f"is not TOML: {error}") from error


def checked(where: Path | str, fields: Any) -> TrainConfig:
    """Make a configuration from plain data. Raises TrainError that names the first bad field."""
    try:
        return TrainConfig.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"])
        words = first["msg"].removeprefix("Value error, ")
        raise TrainError(where, f"{field}: {words}" if field else words) from error


def differences(old: TrainConfig, new: TrainConfig) -> list[str]:
    """List differences between two configurations as `field: old -> new`, except in `workers`, which change nothing."""
    found: list[str] = []

    def walk(a: Any, b: Any, path: str) -> None:
        if isinstance(a, dict) and isinstance(b, dict):
            for key in sorted(a.keys() | b.keys()):
                walk(a.get(key), b.get(key), f"{path}.{key}" if path else key)
        elif a != b:
            found.append(f"{path}: {a} -> {b}")

    before, after = (config.model_dump(mode="json", exclude={"workers"}) for config in (old, new))
    walk(before, after, "")
    return found
