"""What a generator learns to draw, its layers, and its training: the fields of a `train.toml`."""

from __future__ import annotations

import math
import tomllib
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.generator import TrainError
from brushloop.model.outline import Outline
from brushloop.model.raster import centred_origin, coverage
from brushloop.model.strokes import StrokeModel, UnknownModelError, stroke_model

Floats = NDArray[np.floating[Any]]
MAX_BYTES = 64 * 1024
MAX_WEIGHTS = 50_000_000
Range = tuple[float, float]
INPUTS: tuple[str, str] = ("depth_mm", "tilt_deg")
"""The generator's inputs in order: H and alpha."""
ANCHOR_SHARE = (0.76, 0.5)
"""Position of the zero-touch point in the image, from the left and the top, as in the validation's mm field."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True, allow_inf_nan=False)


class Placement(StrEnum):
    """How a stroke is put into the image, at heading 0."""

    CENTRED = "centred"
    """Bounding box centred: the longest press of the paper's grid just fits at 0.2 mm/px."""
    ZERO_TOUCH = "zero-touch"
    """The zero-touch point at ANCHOR_SHARE; O3 lies H tan(alpha) from it."""


class Target(_Table):
    """Presses of one brush by a stroke model, the ranges of the inputs, and the placement of strokes in the image."""

    model: Annotated[str, Field(max_length=64)] = "ccd-bsm"
    """Name of the stroke model; with `qbc` or `bezier`, the paper's figure 12."""
    radius_mm: Annotated[float, Field(gt=0, le=100)] = 6.0
    length_mm: Annotated[float, Field(gt=0, le=400)] = 48.0
    lam: Annotated[float, Field(gt=0, le=10)] = math.pi
    fitted_brush: bool = False
    """Whether lambda or the brush was fitted to captures; if so, every report says it."""
    depth_mm: Range = (11.0, 20.0)
    """Range of H; the defaults of both ranges are the paper's."""
    tilt_deg: Range = (0.0, 10.0)
    """Range of alpha."""
    placement: Placement = Placement.CENTRED
    px_mm: Annotated[float, Field(ge=0.01, le=10)] = 0.2
    size_px: Literal[32, 64, 128, 256] = 128

    @model_validator(mode="after")
    def _check(self) -> Target:
        for name in INPUTS:
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} = [{low:g}, {high:g}] must increase")
        try:
            self.stroke_model.profile(np.array(self.depth_mm), np.array(self.tilt_deg))
        except (DomainError, UnknownModelError) as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def stroke_model(self) -> StrokeModel:
        """The stroke model of the brush."""
        return stroke_model(self.model, Brush(self.radius_mm, self.length_mm), self.lam, fitted=self.fitted_brush)

    def check(self, inputs: Floats) -> None:
        """Raise DomainError for the first of (N, 2) inputs that lies outside its range; NaN counts as outside."""
        for name, column, unit in zip(INPUTS, inputs.T, ("mm", "deg"), strict=True):
            low, high = getattr(self, name)
            bad = column[~((column >= low) & (column <= high))]
            if len(bad):
                raise DomainError(name, float(bad[0]), f"[{low:g}, {high:g}] {unit}", "the range of the generator")

    def origin_mm(self, inputs: Floats, outline: Outline | None = None) -> Floats:
        """Where O3 lies in the images of (N, 2) inputs, (N, 2) from the left and the top.

        `outline` is what is drawn, if it is not the stroke model's.
        """
        depth, tilt = np.asarray(inputs, np.float64).T
        if self.placement is Placement.CENTRED:
            drawn = outline or self.stroke_model.profile(depth, tilt)
            return centred_origin(drawn, size_px=self.size_px, px_mm=self.px_mm)
        side_mm = self.size_px * self.px_mm
        x = ANCHOR_SHARE[0] * side_mm + depth * np.tan(np.radians(tilt))
        return np.column_stack((x, np.full_like(x, ANCHOR_SHARE[1] * side_mm)))

    def images(self, inputs: Floats) -> NDArray[np.float32]:
        """Exact coverage of (N, 2) inputs, (N, size_px, size_px). May raise DomainError."""
        outline = self.stroke_model.profile(*np.asarray(inputs, np.float64).T)
        return coverage(outline, self.origin_mm(inputs, outline), size_px=self.size_px, px_mm=self.px_mm)

    def draw(self, count: int, seed: tuple[int, ...]) -> NDArray[np.float32]:
        """`count` inputs drawn uniformly from the ranges, (count, 2)."""
        low, high = np.transpose([getattr(self, name) for name in INPUTS])
        return np.random.default_rng(seed).uniform(low, high, (count, 2)).astype(np.float32)


class Layers(_Table):
    """Sizes of a network: the layers of the paper's section III-B, which gives none."""

    degree: Annotated[int, Field(ge=1, le=16)] = 4
    """Of the Chebyshev polynomials of each input."""
    width: Annotated[int, Field(ge=1, le=2048)] = 256
    """Of the fully connected layers."""
    depth: Annotated[int, Field(ge=1, le=8)] = 2
    """Their number."""
    channels: Annotated[int, Field(ge=1, le=128)] = 16
    """Of the map of `side` x `side` that they put out."""
    side: Literal[8, 16, 32, 64] = 16

    def shapes(self, size_px: int) -> dict[str, tuple[int, ...]]:
        """The weights by name, with their shapes. Raises ValueError if `side` does not divide the image."""
        if size_px % self.side:
            raise ValueError(f"layers.side = {self.side} does not divide size_px = {size_px}")
        sizes = [self.degree * len(INPUTS), *[self.width] * self.depth, self.channels * self.side**2]
        shapes: dict[str, tuple[int, ...]] = {}
        for k in range(len(sizes) - 1):
            name = f"fully_connected.{2 * k}"  # an activation stands between two layers
            shapes |= {f"{name}.weight": (sizes[k + 1], sizes[k]), f"{name}.bias": (sizes[k + 1],)}
        out = (size_px // self.side) ** 2
        return shapes | {"convolution.0.weight": (out, self.channels, 3, 3), "convolution.0.bias": (out,)}


class Tuning(_Table):
    """Fine-tuning on captured strokes: the initial generator and the captures, by content hash."""

    start_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    captures_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    source: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\r\n]*$")]
    """Origin of the captured ink, for example `loopback rig`."""
    held_out: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Share of captures used only for validation, never for training."""


class TrainConfig(_Table):
    """A whole training. The defaults are the paper's where it gives a number."""

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
    """Steps from one validation, after which the checkpoint is written, to the next."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 5e-3
    """Peak: the rate rises over `warmup_steps`, then falls along half a cosine to 0 at the last step."""
    warmup_steps: Annotated[int, Field(ge=0)] = 50
    ink_weight: Annotated[float, Field(ge=1, le=1000)] = 1.0
    """w of Eq. 6 where the target is ink; w is 1 where it is paper."""
    target_mse: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Converged when the validation MSE is at most this; 0 disables."""
    tuning: Tuning | None = None
    """Origin of weights and images when training on captures."""
    device: Literal["cpu", "cuda"] = "cpu"
    """The device that trains: the CPU, or the first NVIDIA GPU."""

    @model_validator(mode="after")
    def _check(self) -> TrainConfig:
        if self.weight_count > MAX_WEIGHTS:
            raise ValueError(f"layers: {self.weight_count:,} weights; at most {MAX_WEIGHTS:,}")
        return self

    @property
    def weight_count(self) -> int:
        """Number of weights of the network."""
        return sum(math.prod(shape) for shape in self.layers.shapes(self.target.size_px).values())


PRESETS: dict[str, Target] = {
    "press": Target(),
    "anchored": Target(placement=Placement.ZERO_TOUCH, px_mm=0.3),
}
"""Both draw the paper's presses (section IV-B): `press` centred, `anchored` on the validation's millimetre field."""


def preset(name: str) -> TrainConfig:
    """The configuration of a preset. Raises TrainError for an unknown name."""
    if name not in PRESETS:
        raise TrainError(name, f"no such target; known: {', '.join(PRESETS)}")
    return TrainConfig(target=PRESETS[name])


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
    """List the fields in which two configurations differ as `field: old -> new`."""
    pairs = ((name, getattr(old, name), getattr(new, name)) for name in TrainConfig.model_fields)
    return [f"{name}: {before} -> {after}" for name, before, after in pairs if before != after]
