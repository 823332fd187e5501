"""Training and validation images by number: any step's batch follows from (seed, step) alone."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.model.generator import TrainError
from brushloop.model.generator.config import Target, TrainConfig, checked
from brushloop.model.generator.stroke import read_generator

Singles = NDArray[np.float32]
_TRAINING, _VALIDATION, _ORDER, _SPLIT = range(4)


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


@dataclass(frozen=True, slots=True, eq=False)
class Captures:
    """What a generator is tuned on: the generator to start from, and captured presses in its image format."""

    start: Path
    images: Images
    source: str
    """Where the ink comes from, such as `loopback rig`."""

    def config(self, **changes: Any) -> TrainConfig:
        """The configuration of the generator to start from, with fields changed. Raises TrainError."""
        start, pixels = read_generator(self.start).config, self.images.captured
        digest = hashlib.sha256(b"" if pixels is None else self.images.inputs.tobytes() + pixels.tobytes()).hexdigest()
        tuning = {"start_sha256": sha256(self.start), "captures_sha256": digest, "source": self.source[:200]}
        return checked("tune", start.model_dump() | changes | {"tuning": tuning})


def sets(config: TrainConfig, captures: Captures | None = None) -> tuple[Images, Images]:
    """The training and the validation set of a configuration. Raises TrainError if it needs captures."""
    target, seed = config.target, config.seed
    if captures is not None and config.tuning is not None:
        return split(captures.images, seed, config.tuning.held_out)
    if config.tuning is not None:
        raise TrainError("tuning", "needs captured presses: use `brushloop train tune`")
    training = target.draw(config.training_images, (seed, _TRAINING))
    return Images(target, training), Images(target, target.draw(config.validation_images, (seed, _VALIDATION)))


def split(captures: Images, seed: int, held_out: float) -> tuple[Images, Images]:
    """Captures to learn from and to validate on: repeats of one condition, that is of equal inputs, stay together.

    There is at least one condition on each side of two or more.
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
