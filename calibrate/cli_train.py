"""`brushloop train`: train and tune the generator. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brushloop.sessions.terminal import say, shown

if TYPE_CHECKING:
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
) -> None:
    """Train on exact images of CCD-BSM (Algorithm 1), in one process on one device."""
    if context.invoked_subcommand is None:
        from brushloop.model.generator.config import load_config, preset

        _train(preset(target) if config is None else load_config(config), out)


@app.command()
def tune(
    generator: Annotated[Path, typer.Argument(help="The generator.safetensors to start from.")],
    captures: Annotated[Path, typer.Argument(help="Captured strokes, a safetensors file.")],
    out: Annotated[Path, typer.Option(help="Folder of this training.")] = Path("generator-tuned"),
    steps: Annotated[int, typer.Option(min=1, help="Number of steps.")] = 300,
    learning_rate: Annotated[float, typer.Option(min=0, max=1, help="Peak learning rate.")] = 3e-4,
    held_out: Annotated[float, typer.Option(min=0, max=1, help="Share of conditions to validate on.")] = 0.2,
) -> None:
    """Fine-tune a generator on captured strokes; some are held out to validate on."""
    from brushloop.model.generator.data import TuningFiles

    files = TuningFiles(generator, captures)
    every = max(1, steps // 20)
    _train(files.config(held_out, steps=steps, learning_rate=learning_rate, validate_every=every), out, files)


def _train(config: TrainConfig, folder: Path, tuning: TuningFiles | None = None) -> None:
    """Train in the folder, and write the generator's card and the page."""
    from brushloop.calibrate.training import write_training
    from brushloop.model.generator.train import run_training

    with shown() as progress:
        progress("training", 0, config.steps)
        path = run_training(config, folder, lambda step: progress("training", step, config.steps), tuning)
    say(f"Generator: {path}, its card: {path.with_suffix('.md')}", f"Page: {write_training(path, tuning)}")
