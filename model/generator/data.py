"""Training and validation images by number: any step's batch follows from (seed, step) alone.

Captured strokes to tune on come as one safetensors file. Tensors: `images` (n, N, N) uint8 (255 is ink) or float32 in
[0, 1], and one (n,) float32 or float64 tensor for each of the generator's inputs, by name, in its unit. Metadata:
`format` (FORMAT), `px_mm`, `placement`, and `source`, where the images come from. Scale and placement must be the
generator's, else its pixels would mean something else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from brushloop.model.generator import TrainError
from brushloop.model.generator.config import INPUTS, Target, TrainConfig, checked
from brushloop.model.generator.stroke import read_generator, read_tensors

Singles = NDArray[np.float32]
_TRAINING, _VALIDATION, _ORDER, _SPLIT = range(4)
FORMAT = "brushloop-captures-1"
MAX_BYTES = 2**30


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """A numbered set of images: those of captured strokes, or exact ones that are drawn on demand."""

    target: Target
    inputs: Singles
    """(n, 2): H and alpha of each image."""
    captured: Singles | None = None
    """(n, N, N) in [0, 1]; None for exact images."""

    def __len__(self) -> int:
        return len(self.inputs)

    def pick(self, numbers: NDArray[Any]) -> tuple[Singles, Singles]:
        """Inputs (n, 2) and images (n, N, N) of these numbers (n,), or of a mask."""
        inputs = self.inputs[numbers]
        return inputs, self.target.images(inputs) if self.captured is None else self.captured[numbers]


@dataclass(frozen=True, slots=True)
class TuningFiles:
    """The files of a fine-tuning: the generator to start from, and the captures."""

    start: Path
    captures: Path

    def config(self, held_out: float, **changes: Any) -> TrainConfig:
        """The configuration of the generator to start from, with fields changed. Raises TrainError."""
        start = read_generator(self.start).config
        _, source = load_captures(self.captures, start.target)
        hashes = {"start_sha256": sha256(self.start), "captures_sha256": sha256(self.captures)}
        tuning = {**hashes, "source": source, "held_out": held_out}
        return checked("tune", start.model_dump() | changes | {"tuning": tuning})


def sets(config: TrainConfig, tuning: TuningFiles | None = None) -> tuple[Images, Images]:
    """The training and the validation set of a configuration. Raises TrainError for captures that are not its own."""
    target, seed = config.target, config.seed
    if config.tuning is None:
        training = target.draw(config.training_images, (seed, _TRAINING))
        return Images(target, training), Images(target, target.draw(config.validation_images, (seed, _VALIDATION)))
    if tuning is None:
        raise TrainError("captures", "this training learns from captures; name their file")
    if sha256(tuning.captures) != config.tuning.captures_sha256:
        raise TrainError(tuning.captures, "is not the file that this training learns from")
    return split(load_captures(tuning.captures, target)[0], seed, config.tuning.held_out)


def split(captures: Images, seed: int, held_out: float) -> tuple[Images, Images]:
    """Captures to learn from and to validate on: repeats of one condition, that is of equal inputs, stay together.

    There is at least one condition on each side; `load_captures` refuses captures of a single one.
    """
    conditions, condition_of = np.unique(captures.inputs, axis=0, return_inverse=True)
    order = np.random.default_rng((seed, _SPLIT)).permutation(len(conditions))
    count = min(max(1, round(held_out * len(conditions))), len(conditions) - 1)
    held = np.isin(condition_of.reshape(-1), order[:count])
    return Images(captures.target, *captures.pick(~held)), Images(captures.target, *captures.pick(held))


def batch_numbers(count: int, batch: int, seed: int, step: int) -> NDArray[np.int64]:
    """Numbers, out of `count`, of the images in a step's batch, (min(batch, count),); every epoch in another order.

    An incomplete batch at the end of an epoch is dropped.
    """
    batch = min(batch, count)
    epoch, position = divmod(step, count // batch)
    order = np.random.default_rng((seed, _ORDER, epoch)).permutation(count)
    return order[position * batch : (position + 1) * batch]


def save_captures(
    path: Path, inputs: Mapping[str, Any], images: Singles, px_mm: float, placement: str, source: str
) -> None:
    """Write captures, `inputs` each (n,) by name, `images` (n, N, N) in [0, 1]; a source such as `loopback rig`."""
    pixels = np.rint(np.clip(images, 0, 1) * 255).astype(np.uint8)
    tensors = {"images": pixels} | {name: np.asarray(value, np.float32) for name, value in inputs.items()}
    metadata = {"format": FORMAT, "px_mm": repr(px_mm), "placement": placement, "source": source}
    write_whole(path, save(tensors, metadata))


def load_captures(path: Path, target: Target) -> tuple[Images, str]:
    """Captures for a generator of this target, and their source. Raises TrainError if any do not fit."""
    metadata, tensors = read_tensors(path, MAX_BYTES)
    for name, wanted in (("format", FORMAT), ("placement", str(target.placement)), ("px_mm", repr(target.px_mm))):
        if metadata.get(name) != wanted:
            raise TrainError(path, f"{name} is {metadata.get(name, 'missing')[:60]!r}, expected {wanted!r}")
    images, size = tensors.pop("images", np.zeros(0)), target.size_px
    if images.ndim != 3 or images.shape[1:] != (size, size):
        raise TrainError(path, f"images must be (n, {size}, {size})")
    if images.dtype == np.uint8:
        images = images.astype(np.float32) / np.float32(255)
    if images.dtype != np.float32 or not ((images >= 0) & (images <= 1)).all():
        raise TrainError(path, "images must be uint8, or float32 from 0 to 1")
    for name in INPUTS:
        if name not in tensors or tensors[name].shape != (len(images),) or tensors[name].dtype.kind != "f":
            raise TrainError(path, f"{name} must be {len(images)} floating-point numbers")
    for name in sorted(tensors.keys() - set(INPUTS)):
        raise TrainError(path, f"{name[:60]!r} is not an input of the generator")
    inputs = np.stack([tensors[name] for name in INPUTS], axis=-1).astype(np.float32)
    try:
        target.check(inputs)
    except ValueError as error:
        raise TrainError(path, str(error)) from error
    if len(np.unique(inputs, axis=0)) < 2:
        raise TrainError(path, "captures of at least two conditions are needed: one to learn from, one to validate on")
    return Images(target, inputs, images), metadata.get("source", "not stated")[:200].replace("\n", " ")


def sha256(path: Path) -> str:
    """SHA-256 of a file's content. Raises TrainError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise TrainError(path, error.strerror or "cannot be read") from error


def write_whole(path: Path, data: bytes) -> None:
    """Write a temporary file and rename it: after a kill there is the old file or the new one."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(data)
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
