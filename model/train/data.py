"""Training and validation images by number: any step's batch follows from (seed, step) alone.

So a resumed training needs no state of a random generator, and every process of a group can take its own share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from model.generator.targets import Target
from model.train.config import TrainConfig

_TRAINING, _VALIDATION, _ORDER, _SPLIT = range(4)


class Images(Protocol):
    """A numbered set of (inputs, image)."""

    def __len__(self) -> int:
        """How many."""
        ...

    def pick(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs (n, P) and images (n, N, N) of these numbers (n,)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Exact:
    """Images that are made when they are asked for: the target's exact coverage of `inputs` (n, P)."""

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
    """The training and the validation set of a configuration; raises ValueError where the target refuses nearly all."""
    target = config.build_target()
    counts = ((config.training_images, _TRAINING), (config.validation_images, _VALIDATION))
    training, validation = (
        Exact(target, target.draw(count, _generator(config.seed, stream)), config.threads) for count, stream in counts
    )
    return training, validation


def split(captures: Kept, seed: int, held_out: float) -> tuple[Kept, Kept]:
    """Captures to learn from and to validate on, at least one of each; raises ValueError for fewer than two."""
    if len(captures) < 2:
        raise ValueError("at least two captures are needed: one to learn from, one to validate on")
    order = torch.randperm(len(captures), generator=_generator(seed, _SPLIT))
    count = min(max(1, round(held_out * len(captures))), len(captures) - 1)
    held, kept = order[:count].sort().values, order[count:].sort().values
    return Kept(*captures.pick(kept)), Kept(*captures.pick(held))


def batch_numbers(count: int, batch: int, seed: int, step: int) -> Tensor:
    """Which of `count` images are in a step's batch, (min(batch, count),): every epoch in another order.

    What does not fill a batch at the end of an epoch is left out of it.
    """
    batch = min(batch, count)
    epoch, position = divmod(step, count // batch)
    order = torch.randperm(count, generator=_generator(seed, _ORDER, epoch))
    return order[position * batch : (position + 1) * batch]


def _generator(seed: int, *stream: int) -> torch.Generator:
    """A generator of its own for each stream of a seed."""
    state = np.random.SeedSequence([seed, *stream]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state) & (2**63 - 1))
