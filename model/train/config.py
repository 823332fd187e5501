"""Configuration of a training, read from TOML: frozen, validated, and stored in the generator's file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from brushloop.model.generator import TrainError
from brushloop.model.generator.stroke import MAX_WEIGHTS, GeneratorFile, Layers
from brushloop.model.generator.targets import Placement, Target

MAX_BYTES = 64 * 1024


class Tuning(BaseModel):
    """Fine-tuning on captured strokes: the initial generator and the captures, by content hash."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    start_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    captures_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    source: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\r\n]*$")]
    """Origin of the captured ink, for example `loopback rig`."""
    held_out: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Share of captures used only for validation, never for training."""


class TrainConfig(BaseModel):
    """A whole training. The defaults are the paper's where it gives a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    target: Target = Target()
    layers: Layers = Layers()
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
    tuning: Tuning | None = None
    """Origin of weights and images when training on captures."""
    threads: Annotated[int, Field(ge=1, le=256)] = 1
    """Threads of torch; a different number changes the last bits of the weights."""
    device: Literal["cpu", "cuda"] = "cpu"
    """The device that trains: the CPU, or the first NVIDIA GPU."""

    @model_validator(mode="after")
    def _check(self) -> TrainConfig:
        if self.weight_count() > MAX_WEIGHTS:
            raise ValueError(f"layers: {self.weight_count():,} weights; at most {MAX_WEIGHTS:,}")
        return self

    def weight_count(self) -> int:
        """Number of weights of the network."""
        return self.layers.weight_count(self.target.size_px)


PRESETS: dict[str, Target] = {
    "press": Target(),
    "anchored": Target(placement=Placement.ZERO_TOUCH, px_mm=0.3),
}
"""Both draw the paper's presses (section IV-B): `press` centred, `anchored` on the validation's millimetre field."""


def preset(name: str, **changes: Any) -> TrainConfig:
    """Make the configuration of a preset with fields changed. Raises TrainError for an unknown name or bad field."""
    if name not in PRESETS:
        raise TrainError(name, f"no such target; known: {', '.join(PRESETS)}")
    return checked(f"target {name}", {"target": PRESETS[name], **changes})


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


def config_of(path: Path, file: GeneratorFile) -> TrainConfig:
    """The configuration that a generator was trained with. Raises TrainError if its file names none."""
    return checked(path, file.config)


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
    """List the fields in which two configurations differ as `field: old -> new`."""
    pairs = ((name, getattr(old, name), getattr(new, name)) for name in TrainConfig.model_fields)
    return [f"{name}: {before} -> {after}" for name, before, after in pairs if before != after]
