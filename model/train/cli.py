"""`brushloop train`: train and tune the generator. Heavy imports wait until a command runs.

A command that trains returns the folder of the training, of which the front door has the page written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="Train the neural stroke generator, or tune it on captures.")


@app.callback(invoke_without_command=True)
def train(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of this training; the same command resumes it.")] = Path(
        "generator"
    ),
    target: Annotated[str, typer.Option(help="press, anchored, all, qbc or bezier.")] = "press",
    config: Annotated[Path | None, typer.Option(help="A train.toml instead of a target's defaults.")] = None,
    steps: Annotated[int | None, typer.Option(help="Largest number of steps, G in Algorithm 1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of weights and images.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of torch.")] = None,
    workers: Annotated[int | None, typer.Option(help="Threads that draw images ahead.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
) -> Path | None:
    """Train on exact images of a stroke model (Algorithm 1), in one process on one device."""
    if context.invoked_subcommand is not None:
        return None
    from brushloop.model.train import config as configs
    from brushloop.model.train.run import train_with_bar

    changes = {"steps": steps, "seed": seed, "threads": threads, "workers": workers, "device": device}
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
    from brushloop.model.train.checkpoint import load_weights, sha256
    from brushloop.model.train.config import checked
    from brushloop.model.train.data import load_captures
    from brushloop.model.train.run import Tuning, train_with_bar

    before = load_weights(generator)[0]
    _, source = load_captures(captures, before)
    fields: dict[str, Any] = before.model_dump() | {
        "steps": steps,
        "learning_rate": learning_rate,
        "seed": seed,
        "validate_every": max(1, steps // 20),
        "tuning": {
            "start_sha256": sha256(generator),
            "captures_sha256": sha256(captures),
            "source": source,
            "held_out": held_out,
        },
    }
    return train_with_bar(checked("tune", fields), out, Tuning(generator, captures))
