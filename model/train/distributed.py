"""One process, or several that train the same weights: gloo on CPUs, nccl on GPUs, started by torchrun."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta

import torch
from torch import Tensor

from model.train.errors import TrainError

_TIMEOUT = timedelta(minutes=10)  # the first process also writes files while the others wait


@dataclass(frozen=True, slots=True)
class Group:
    """This process' rank among `world` processes."""

    rank: int = 0
    world: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def first(self) -> bool:
        """Whether this process writes the files and shows progress."""
        return self.rank == 0

    def share(self, numbers: Tensor) -> Tensor:
        """This process' part of a global batch, (n,) -> about (n / world,)."""
        return numbers.tensor_split(self.world)[self.rank]

    def add(self, values: Tensor) -> Tensor:
        """Sum `values` over all processes, in place."""
        if self.world > 1:
            torch.distributed.all_reduce(values)
        return values

    def wait(self) -> None:
        """Wait until all processes have called this."""
        if self.world > 1:
            torch.distributed.barrier()


@contextmanager
def joined(device: str) -> Iterator[Group]:
    """Join the group that torchrun's environment describes; leave it when the block ends.

    Raises TrainError for "cuda" without a GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise TrainError("device", "cuda was asked for, but this machine has no usable GPU")
    world = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    place = torch.device("cuda", local) if device == "cuda" else torch.device("cpu")
    if place.type == "cuda":
        torch.cuda.set_device(place)
    if world == 1:
        yield Group(device=place)
        return
    torch.distributed.init_process_group("nccl" if place.type == "cuda" else "gloo", timeout=_TIMEOUT)
    try:
        yield Group(torch.distributed.get_rank(), world, place)
    finally:
        torch.distributed.destroy_process_group()
