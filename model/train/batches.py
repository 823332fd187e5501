"""Batches of training images, drawn ahead of the step that needs them by threads of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from torch import Tensor

from model.train.config import TrainConfig
from model.train.data import Images, batch_numbers
from model.train.distributed import Group

_AHEAD = 2  # batches per worker: one being drawn, one waiting


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """This process' share of a step's images: `inputs` (n, P), `target` (n, N, N), out of `count` in all processes."""

    count: int
    inputs: Tensor
    target: Tensor


def batches(config: TrainConfig, images: Images, group: Group, start: int) -> Generator[Batch]:
    """The batches of the steps from `start` to the last, in order; close the iterator to end the threads early.

    A batch follows from the seed and its step alone, so the number of `config.workers` changes no image. Without
    workers each batch is drawn when it is asked for. The compiled rasters release the interpreter's lock, so threads
    draw beside the training.
    """

    def draw(step: int) -> Batch:
        numbers = batch_numbers(len(images), config.batch, config.seed, step)
        inputs, target = images.pick(group.share(numbers))
        return Batch(len(numbers), inputs, target)

    steps = range(start, config.steps)
    if config.workers == 0:
        yield from map(draw, steps)
        return
    pool = ThreadPoolExecutor(config.workers)
    waiting: deque[Future[Batch]] = deque()
    try:
        for step in steps:
            waiting.append(pool.submit(draw, step))
            if len(waiting) > _AHEAD * config.workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
