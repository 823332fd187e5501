"""A training on a terminal: a bar with the time that is left, and Ctrl-C that leaves a checkpoint."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from model.train.config import TrainConfig
from model.train.distributed import joined
from model.train.loop import Validation
from model.train.run import Tuning, run_training


class Bar:
    """The bar, with the last losses beside it."""

    def __init__(self, progress: Progress, steps: int) -> None:
        self._progress = progress
        self._task: TaskID = progress.add_task("training", total=steps, loss="", validation="")

    def stepped(self, step: int, loss: float) -> None:
        """See `Watcher.stepped`."""
        self._progress.update(self._task, completed=step, loss=f"left, MSE {loss:.1e}")

    def validated(self, validation: Validation) -> None:
        """See `Watcher.validated`."""
        self._progress.update(self._task, validation=f"held out {validation.mse:.1e}")
        if validation.blank:
            self._progress.console.print(
                f"step {validation.step}: the generator draws {validation.ink_share:.2%} ink where the targets hold "
                f"{validation.target_share:.2%}; training ends if that stays"
            )


def run(config: TrainConfig, folder: Path, tuning: Tuning | None, events: bool) -> None:
    """Train with a bar in the first process. Raises as `run_training`."""
    with joined(config.device) as group, _asked_to_stop() as stopping:
        console = Console(quiet=not group.first)
        words = TextColumn("{task.fields[loss]} {task.fields[validation]}")
        columns = (BarColumn(bar_width=16), MofNCompleteColumn(), TimeRemainingColumn(compact=True), words)
        with Progress(*columns, console=console, disable=not group.first) as progress:
            bar = Bar(progress, config.steps)
            path = run_training(config, folder, group, bar, stopping, tuning=tuning, events=events)
        console.print(f"Generator: {path}, its card: {path.with_suffix('.md')}", markup=False, soft_wrap=True)


@contextmanager
def _asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a wish that the loop sees after the step at hand."""
    wishes: list[int] = []
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, _: wishes.append(number)) for number in signals}
    try:
        yield lambda: bool(wishes)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
