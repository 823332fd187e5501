"""A generator calibrated to a brush, judged on cells that it has not seen.

It is tuned on the captures of all other cells and, where the session was fitted, on images of the CCD-BSM that was
fitted to those same captures, at any depth and tilt: as the paper's generator learns from CCD-BSM. Each fold of cells
has a tuning of its own, in a folder named after all that it follows from; one that was killed goes on from its
checkpoint.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.compare.simulate import brush_of
from calibrate.validate.candidates import Generator
from calibrate.validate.captures_file import Laid, lay_captures, write_captures
from calibrate.validate.heldout import Cell, fitted_press, folds
from calibrate.validate.jobs import VERSION
from calibrate.validate.sources import Opened

if TYPE_CHECKING:
    from calibrate.validate.steps import Progress
    from model.train.loop import Validation

FOLDS = 5
"""A tuning takes a minute, so cells are left out by fifths."""
LEARNING_RATE = 2e-3
NO_CELL: Cell = (-1.0, -1.0)
"""Of an image that is no capture, so that it is never left out."""
IMAGES = 400
"""Of the fitted CCD-BSM, beside the captures; drawn evenly from the generator's ranges."""
HELD_OUT = 0.1
"""Of the captures that are tuned on; only the curve of the training needs them."""


@dataclass(slots=True)
class _Told:
    """Passes the steps of a training on."""

    progress: Progress
    what: str
    before: int
    total: int

    def stepped(self, step: int, loss: float) -> None:
        """See `model.train.run.Progress`."""
        self.progress(self.what, self.before + step, self.total)

    def validated(self, validation: Validation) -> None:
        """See `model.train.run.Progress`."""


def tuned_by_cell(
    session: Opened,
    fits: dict[Cell, dict[str, Any]],
    generator: Generator,
    steps: int,
    work: Path,
    progress: Progress,
) -> dict[Cell, Path]:
    """The generator's file for each cell, tuned without it; empty for fewer than two cells.

    `fits` has for each cell a finished `refit_job` that left out the same `FOLDS`. Raises what `load_generator` and a
    training do.
    """
    from model.train.checkpoint import load_weights, sha256
    from model.train.config import checked
    from model.train.distributed import joined
    from model.train.run import Tuning, run_training

    left = folds(list(fits), FOLDS)
    calibration = session.calibration.digest if session.calibration is not None else ""
    made: dict[Cell, Path] = {}
    laid: Laid | None = None
    what = f"{session.header.session_id}: generator tuned, cells left out by fifths"
    for number, fold in enumerate(left):
        fit = fits[fold[0]]["fitted"]
        inputs = f"tune {VERSION} {session.sha256} {calibration} {generator.sha256} {steps} {LEARNING_RATE} {fold} "
        inputs += f"{IMAGES} {fit}"
        folder = work / "tuned" / hashlib.sha256(inputs.encode()).hexdigest()[:32]
        path = folder / "generator.safetensors"
        if not path.exists():
            captures = folder / "captures.safetensors"
            if not captures.exists():
                laid = laid or lay_captures([session], generator.path)
                write_captures(_with_images(laid, session, fit, generator), captures, fold)
            config, _, _ = load_weights(generator.path)
            tuning: dict[str, Any] = {
                "start_sha256": generator.sha256,
                "captures_sha256": sha256(captures),
                "source": str(session.header.source),
                "held_out": HELD_OUT,
            }
            fields: dict[str, Any] = config.model_dump() | {
                "steps": steps,
                "learning_rate": LEARNING_RATE,
                "seed": 0,
                "validate_every": steps,
                "picture_every": steps,
                "checkpoint_every": max(1, steps // 4),
                "tuning": tuning,
            }
            told = _Told(progress, what, number * steps, len(left) * steps)
            with joined(config.device) as group:
                run_training(
                    checked("tune", fields),
                    folder,
                    group,
                    told,
                    lambda: False,
                    tuning=Tuning(generator.path, captures),
                )
        made |= dict.fromkeys(fold, path)
    return made


def _with_images(laid: Laid, session: Opened, fit: dict[str, Any] | None, generator: Generator) -> Laid:
    """The captures, and images of the fitted brush where the generator's inputs are what it is a function of."""
    import torch

    from model.fitted_shape import fitted_model
    from model.generator.targets import Placement, Target
    from model.train.checkpoint import load_generator

    brush = brush_of(session.header)
    target = load_generator(generator.path, brush).target
    ranges = {spec.name: (spec.low, spec.high) for spec in target.inputs}
    if fit is None or set(ranges) != {"height_mm", "tilt_deg"} or target.placement is Placement.BASE:
        return laid
    fitted = fitted_model(fitted_press(fit, float(brush.radius_mm), float(brush.length_mm)))
    drawn = Target(fitted, ranges, {}, target.placement, target.px_mm, target.size_px)
    inputs = drawn.draw(IMAGES, torch.Generator().manual_seed(0))
    names = [spec.name for spec in drawn.inputs]
    return replace(
        laid,
        images=[*laid.images, *(np.asarray(image, np.float32) for image in drawn.images(inputs).numpy())],
        inputs=[*laid.inputs, *({name: float(row[k]) for k, name in enumerate(names)} for row in inputs)],
        cells=[*laid.cells, *[NO_CELL] * IMAGES],
    )
