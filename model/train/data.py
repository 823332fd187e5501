"""Training and validation images by number: any step's batch follows from (seed, step) alone.

So a resumed training needs no random-generator state.

Captured strokes to tune on come as one safetensors file. Tensors: `images` (n, N, N) uint8 (255 is ink) or float32 in
[0, 1], and one (n,) float32 or float64 tensor for each of the generator's inputs, by name, in its unit. Metadata:
`format` (FORMAT), `px_mm`, `placement`, and `source`, where the images come from. Scale and placement must be the
generator's, else its pixels would mean something else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from brushloop.model.generator.targets import Target
from brushloop.model.train.checkpoint import read_tensors, write_whole
from brushloop.model.train.config import TrainConfig
from brushloop.model.train.errors import TrainError

_TRAINING, _VALIDATION, _ORDER, _SPLIT = range(4)
FORMAT = "brushloop-captures-1"
MAX_BYTES = 2**30
_AHEAD = 2  # batches per worker: one being drawn, one waiting


class Images(Protocol):
    """A numbered set of (inputs, image)."""

    def __len__(self) -> int:
        """Number of images."""
        ...

    def pick(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs (n, P) and images (n, N, N) of these numbers (n,)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Exact:
    """Images made on demand: the target's exact coverage of `inputs` (n, P)."""

    target: Target
    inputs: Tensor
    threads: int = 1

    def __len__(self) -> int:
        return len(self.inputs)

    def pick(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """See `Images.pick`."""
        chosen = self.inputs[numbers]
        return chosen, self.target.images(chosen, self.threads)


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """Images that were captured: `inputs` (n, P) and `images` (n, N, N) in [0, 1]."""

    inputs: Tensor
    images: Tensor

    def __len__(self) -> int:
        return len(self.inputs)

    def pick(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """See `Images.pick`."""
        return self.inputs[numbers], self.images[numbers]


def exact_sets(config: TrainConfig) -> tuple[Exact, Exact]:
    """The training and the validation set of a configuration; raises ValueError if the target rejects nearly all."""
    target = config.build_target()
    counts = ((config.training_images, _TRAINING), (config.validation_images, _VALIDATION))
    training, validation = (
        Exact(target, target.draw(count, _generator(config.seed, stream)), config.threads) for count, stream in counts
    )
    return training, validation


def split(captures: Kept, seed: int, held_out: float) -> tuple[Kept, Kept]:
    """Captures to learn from and to validate on: repeats of one condition, that is of equal inputs, stay together.

    There is at least one condition on each side; `load_captures` refuses captures of a single one.
    """
    conditions, condition_of = torch.unique(captures.inputs, dim=0, return_inverse=True)
    order = torch.randperm(len(conditions), generator=_generator(seed, _SPLIT))
    count = min(max(1, round(held_out * len(conditions))), len(conditions) - 1)
    held = torch.isin(condition_of, order[:count])
    return Kept(*captures.pick(~held)), Kept(*captures.pick(held))


def batch_numbers(count: int, batch: int, seed: int, step: int) -> Tensor:
    """Numbers, out of `count`, of the images in a step's batch, (min(batch, count),); every epoch in another order.

    An incomplete batch at the end of an epoch is dropped.
    """
    batch = min(batch, count)
    epoch, position = divmod(step, count // batch)
    order = torch.randperm(count, generator=_generator(seed, _ORDER, epoch))
    return order[position * batch : (position + 1) * batch]


def _generator(seed: int, *stream: int) -> torch.Generator:
    """An independent generator for each stream of a seed."""
    state = np.random.SeedSequence([seed, *stream]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state) & (2**63 - 1))


def save_captures(
    path: Path, inputs: dict[str, Tensor], images: Tensor, px_mm: float, placement: str, source: str
) -> None:
    """Write captures, `inputs` each (n,) by name, `images` (n, N, N) in [0, 1]; a source such as `loopback rig`."""
    pixels = (images.clamp(0, 1) * 255).round().to(torch.uint8)
    tensors = {"images": pixels.contiguous()} | {name: value.float().contiguous() for name, value in inputs.items()}
    metadata = {"format": FORMAT, "px_mm": repr(px_mm), "placement": placement, "source": source}
    write_whole(path, save(tensors, metadata))


def load_captures(path: Path, config: TrainConfig) -> tuple[Kept, str]:
    """Captures for a generator of this configuration, and their source. Raises TrainError if any do not fit."""
    metadata, tensors = read_tensors(path, MAX_BYTES)
    if metadata.get("format") != FORMAT:
        raise TrainError(path, f"format is {metadata.get('format', 'missing')[:60]!r}, expected {FORMAT!r}")
    placement, size = config.target.placement, config.target.size_px
    if metadata.get("placement") != placement:
        raise TrainError(
            path, f"placement is {metadata.get('placement', 'missing')[:40]!r}, the generator's {placement}"
        )
    if metadata.get("px_mm") != repr(config.target.px_mm):
        raise TrainError(
            path, f"px_mm is {metadata.get('px_mm', 'missing')[:40]}, the generator's {config.target.px_mm}"
        )
    images = tensors.pop("images", None)
    if images is None or images.ndim != 3 or images.shape[1:] != (size, size):
        raise TrainError(path, f"images must be (n, {size}, {size})")
    if images.dtype == torch.uint8:
        images = images.float() / 255
    if images.dtype != torch.float32 or not ((images >= 0) & (images <= 1)).all():
        raise TrainError(path, "images must be uint8, or float32 from 0 to 1")
    columns: list[Tensor] = []
    for spec in config.build_target().inputs:
        value = tensors.pop(spec.name, None)
        if value is None or value.shape != (len(images),) or not value.is_floating_point():
            raise TrainError(path, f"{spec.name} must be {len(images)} floating-point numbers")
        bad = ~((value >= spec.low) & (value <= spec.high))
        if bad.any():
            raise TrainError(path, f"{spec.name} = {float(value[bad][0]):g} is outside [{spec.low:g}, {spec.high:g}]")
        columns.append(value.float())
    for name in sorted(tensors):
        raise TrainError(path, f"{name[:60]!r} is not an input of the generator")
    inputs = torch.stack(columns, dim=-1)
    if len(torch.unique(inputs, dim=0)) < 2:
        raise TrainError(path, "captures of at least two conditions are needed: one to learn from, one to validate on")
    return Kept(inputs, images), metadata.get("source", "not stated")[:200].replace("\n", " ")


def batches(config: TrainConfig, images: Images, start: int) -> Generator[tuple[Tensor, Tensor]]:
    """Inputs (n, P) and images (n, N, N) of the steps from `start` to the last, in order.

    Close the iterator to end the threads early.

    A batch follows from the seed and its step alone, so the number of `config.workers` changes no image. Without
    workers each batch is drawn when it is asked for. The compiled rasters release the interpreter's lock, so threads
    draw beside the training.
    """

    def draw(step: int) -> tuple[Tensor, Tensor]:
        return images.pick(batch_numbers(len(images), config.batch, config.seed, step))

    steps = range(start, config.steps)
    if config.workers == 0:
        yield from map(draw, steps)
        return
    pool = ThreadPoolExecutor(config.workers)
    waiting: deque[Future[tuple[Tensor, Tensor]]] = deque()
    try:
        for step in steps:
            waiting.append(pool.submit(draw, step))
            if len(waiting) > _AHEAD * config.workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
