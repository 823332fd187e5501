"""`brushloop train`: train and tune the generator. Heavy imports wait until a command runs.

A command that trains returns the folder of the training, of which the front door has the page written.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.progress import Progress as ProgressBar

    from brushloop.model.generator.config import TrainConfig
    from brushloop.model.generator.data import TuningFiles

app = typer.Typer(help="Train the neural stroke generator, or tune it on captures.")


@app.callback(invoke_without_command=True)
def train(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of this training; the same command resumes it.")] = Path(
        "generator"
    ),
    target: Annotated[str, typer.Option(help="press or anchored.")] = "press",
    config: Annotated[Path | None, typer.Option(help="A train.toml instead of a target's defaults.")] = None,
    steps: Annotated[int | None, typer.Option(help="Largest number of steps, G in Algorithm 1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of weights and images.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of torch.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
) -> Path | None:
    """Train on exact images of CCD-BSM (Algorithm 1), in one process on one device."""
    if context.invoked_subcommand is not None:
        return None
    from brushloop.model.generator import config as configs

    changes = {"steps": steps, "seed": seed, "threads": threads, "device": device}
    changes = {name: value for name, value in changes.items() if value is not None}
    if config is None:
        chosen = configs.preset(target, **changes)
    else:
        chosen = configs.checked(config, configs.load_config(config).model_dump() | changes)
    return train_with_bar(chosen, out)


@app.command()
def tune(
    generator: Annotated[Path, typer.Argument(help="The generator.safetensors to start from.")],
    captures: Annotated[Path, typer.Argument(help="Captured strokes, a safetensors file.")],
    out: Annotated[Path, typer.Option(help="Folder of this training.")] = Path("generator-tuned"),
    steps: Annotated[int, typer.Option(min=1, help="Number of steps.")] = 300,
    learning_rate: Annotated[float, typer.Option(min=0, max=1, help="Peak learning rate.")] = 3e-4,
    held_out: Annotated[float, typer.Option(min=0, max=1, help="Share of conditions to validate on.")] = 0.2,
    seed: Annotated[int, typer.Option(min=0, help="Which conditions are held out, and the order of the rest.")] = 0,
) -> Path:
    """Fine-tune a generator on captured strokes; some are held out to validate on."""
    from brushloop.model.generator.data import TuningFiles, load_captures
    from brushloop.model.generator.stroke import read_generator

    files = TuningFiles(generator, captures)
    _, source = load_captures(captures, read_generator(generator).config.target)
    changes = {"steps": steps, "learning_rate": learning_rate, "seed": seed, "validate_every": max(1, steps // 20)}
    return train_with_bar(files.config(source, held_out, **changes), out, files)


def train_with_bar(config: TrainConfig, folder: Path, tuning: TuningFiles | None = None) -> Path:
    """Train with a progress bar; return the folder. Raises as `run_training`."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar

    from brushloop.model.generator.train import run_training

    columns = (BarColumn(bar_width=16), MofNCompleteColumn(), TimeRemainingColumn(compact=True))
    columns += (TextColumn("{task.fields[mse]}"),)
    with _asked_to_stop() as stopping, ProgressBar(*columns) as progress:
        path = run_training(config, folder, Bar(progress, config.steps), stopping, tuning)
    card = path.with_suffix(".md")
    progress.console.print(f"Generator: {path}, its card: {card}", markup=False, soft_wrap=True)
    return folder


class Bar:
    """A progress bar that shows the latest errors; where there is no terminal, a line for each tenth of the steps."""

    def __init__(self, progress: ProgressBar, steps: int) -> None:
        self._progress, self._steps, self._tenths = progress, steps, 0
        self._task = progress.add_task("training", total=steps, mse="")

    def __call__(self, step: int, loss: float, held_out: float) -> None:
        """See `model.generator.train.Progress`."""
        words = f"MSE {loss:.1e}" + (f", held out {held_out:.1e}" if math.isfinite(held_out) else "")
        self._progress.update(self._task, completed=step, mse=words)
        if self._progress.console.is_terminal or 10 * step // self._steps <= self._tenths:
            return
        self._tenths = 10 * step // self._steps
        left_s = self._progress.tasks[self._task].time_remaining
        left = f", about {left_s:.0f} s left" if left_s and step < self._steps else ""
        self._progress.console.print(f"training: {step} of {self._steps} steps{left}, {words}")


@contextmanager
def _asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a request to stop after the current step."""
    requests: list[int] = []
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, _: requests.append(number)) for number in signals}
    try:
        yield lambda: bool(requests)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
