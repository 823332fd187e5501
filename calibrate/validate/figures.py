"""The figures of the report: the paper's 3, 7, 8, 10 and 11 as pictures of presses, and charts of scores and losses.

Every figure shows its source in the picture itself.
"""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.compare import shown
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.presses import Press
from brushloop.calibrate.report import BLUE, COLOURS, ORANGE, Axis, Marks, Panel, chart_uri, ink_uri, overlay_uri
from brushloop.calibrate.validate.run import Outcome
from brushloop.calibrate.validate.tables import NORMAL, STRICT, Report

MAX_POINTS = 200
MAX_CELLS, EXTREMES = 5, 6
MAX_CURVE_BYTES = 64 * 1024 * 1024


Curve = tuple[str, list[int], list[float]]
"""Name, steps and validation losses of a training."""


def read_curve(text: str) -> Curve:
    """Read `NAME=FOLDER`, a folder that `brushloop train` wrote. Raises `CalibrationError` if it holds no curve."""
    name, _, folder = text.partition("=")
    path = Path(folder) / "validation.csv"
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_CURVE_BYTES).decode())))
        return name, [int(row["step"]) for row in rows], [float(row["mse"]) for row in rows]
    except (KeyError, TypeError, ValueError):
        raise CalibrationError(str(path), "is not a table of validation losses (step, mse)") from None


def extremes(outcome: Outcome, model: str) -> tuple[list[int], list[int]]:
    """Numbers of the best and of the worst presses of a model, from the outermost; none without a model."""
    if not model:
        return [], []
    csim = outcome.scores.of_key(model, STRICT)[:, 0]
    known = np.flatnonzero(np.isfinite(csim))
    order: list[int] = known[np.argsort(csim[known], kind="stable")].tolist()
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[::-1][:count], order[:count]


def pictured(outcome: Outcome, k: int, model: str) -> dict[str, Any]:
    """A press with what the model predicts for it, their difference, and their scores: the paper's figures 7 and 8."""
    press, csim, ssim = outcome.scores.presses[k], np.nan, np.nan
    captured, drawn = shown(press.images), outcome.predicted(press)
    images = {"captured": ink_uri(captured)}
    if model in drawn:
        predicted = shown(drawn[model])
        images |= {"predicted": ink_uri(predicted), "difference": overlay_uri(captured, predicted)}
        csim, ssim = 100.0 * outcome.scores.of_key(model, STRICT)[k]
    return {"press": press, "images": images, "scored": bool(np.isfinite(csim)), "csim": csim, "ssim": ssim}


def side_by_side(outcome: Outcome) -> dict[str, Any]:
    """Some captures next to the prediction of every model: the paper's figures 3, 10 and 11."""
    labels = {model.name: model.info.label for group in outcome.models.values() for model in group}
    lines: list[tuple[Press, list[str]]] = []
    for press in (outcome.scores.presses[k] for k in first_of_cells(outcome, MAX_CELLS)):
        drawn = outcome.predicted(press)
        predictions = (ink_uri(shown(drawn[name])) if name in drawn else "" for name in labels)
        lines.append((press, [ink_uri(shown(press.images)), *predictions]))
    return {"labels": list(labels.values()), "lines": lines}


def first_of_cells(outcome: Outcome, most: int) -> list[int]:
    """The first capture of each condition; with more than `most` of them, of evenly spaced ones."""
    first = [numbers[0] for numbers in outcome.scores.conditions().values()]
    count = min(len(first), most)
    return [first[n * (len(first) - 1) // max(count - 1, 1)] for n in range(count)]


def distributions(outcome: Outcome, report: Report) -> str:
    """CSIM of every stroke by model in both alignments, with the average and its interval."""
    models = [model for name in outcome.scores.models if (model := report.model(name)) is not None][::-1]
    panels: list[Panel] = []
    for key in (STRICT, NORMAL):
        rng = np.random.default_rng(0)  # jitter only, so that points do not hide each other
        marks: list[Marks] = []
        for place, model in enumerate(models):
            stat = report.stat(model.name, key)
            if stat is None:
                continue
            csim = 100.0 * outcome.scores.of_key(model.name, key)[:, 0]
            csim = csim[np.isfinite(csim)][:: max(1, -(-len(csim) // MAX_POINTS))]
            marks.append(Marks(csim, place + 0.14 * rng.uniform(-1, 1, len(csim)), dot_px=3.0))
            if stat.csim.avg_interval is not None:
                marks.append(Marks(stat.csim.avg_interval, [place] * 2, ORANGE, line_px=3.0))
            marks.append(Marks([stat.csim.avg] * 2, [place - 0.3, place + 0.3], ORANGE, line_px=3.0))
        labels = {float(place): model.label for place, model in enumerate(models)}
        panels.append(Panel(f"{key[0]}, binary", Axis("CSIM, %"), Axis(ticks=labels), marks))
    return chart_uri(panels, (1060, 120 + 32 * len(models)), report.label)


def by_strokes(report: Report) -> str:
    """CSIM on presses that were not fitted, against the number of presses that were."""
    marks: list[Marks] = []
    for name, colour in (("CCD-BSM", ORANGE), ("Bézier", BLUE)):
        csim: dict[int, list[float]] = {}
        for step in report.by_strokes:
            if step.model == name:
                csim.setdefault(step.strokes, []).append(step.csim)
        counts = sorted(csim)
        means = [np.mean(csim[count]) for count in counts]
        marks.append(Marks(counts, means, colour, f"{name} fitted", dot_px=6.0, line_px=1.5))
    ticks = {float(step.strokes): str(step.strokes) for step in report.by_strokes}
    across, up = Axis("presses that were fitted", ticks, log=True), Axis("CSIM on all others, %")
    return chart_uri([Panel("mm, binary", across, up, marks)], (720, 340), report.label)


def losses(curves: Sequence[Curve]) -> str:
    """Validation losses of generators side by side: the paper's figure 9, also for the strokes of figure 12."""
    colours = itertools.cycle(COLOURS)
    marks = [
        Marks(steps, losses, colour, name, dot_px=4.0, line_px=1.5)
        for (name, steps, losses), colour in zip(curves, colours, strict=False)
    ]
    title, up = "networks trained on exact images of stroke models", Axis("validation loss (MSE)", log=True)
    return chart_uri([Panel(title, Axis("step"), up, marks)], (720, 340))
