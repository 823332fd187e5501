"""Pictures of a report of presses, as data URIs. Every plot shows its source in the picture itself."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.compare.place import KEYS, Alignment, Pixels, Tone, unpack
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.report import BLUE, ORANGE, ink_uri, overlay_uri, plot, plot_uri
from brushloop.calibrate.validate.report.data import Report
from brushloop.calibrate.validate.run import Outcome
from brushloop.model.ccdbsm import DomainError

ROWS = slice(32, 96)
"""Rows to show: the middle half of a field, as a press is at most half as thick as the field is high."""
MAX_POINTS = 200
LABEL_CHARS = 120
"""As many fit on a line over two plots; a label that names a simulated brush is longer."""
MAX_SAMPLES, MAX_CELLS = 15, 5
GRAY_MM, MM_BINARY = KEYS.index((Alignment.MM, Tone.GRAY)), (Alignment.MM, Tone.BINARY)
MAX_CURVE_BYTES = 64 * 1024 * 1024


def distributions(outcome: Outcome, report: Report) -> str:
    """CSIM of every stroke by model in both alignments, with the average and its interval."""
    labels = {rival.name: rival.label for rival in report.rivals}
    names = [name for name in outcome.scores.models if name in labels]
    figure, axes = plot(1, 2, (11.0, 0.9 + 0.36 * len(names)))
    for axis, alignment in zip(axes, (Alignment.MM, Alignment.SIZE_NORMALISED), strict=True):
        key = KEYS.index((alignment, Tone.BINARY))
        rng = np.random.default_rng(0)  # jitter only, so that points do not hide each other
        for place, name in enumerate(reversed(names)):
            values = 100.0 * outcome.scores.of(name)[:, key, 0]
            values = values[np.isfinite(values)]
            stat = report.stat(name, alignment, Tone.BINARY, "csim")
            if stat is None:
                continue
            if len(values) > 3 and np.ptp(values) > 1e-6:
                parts: Any = axis.violinplot([values], [place], orientation="horizontal", widths=0.8, showextrema=False)
                for body in parts["bodies"]:
                    body.set(facecolor=BLUE, alpha=0.18)
            some = values[:: max(1, -(-len(values) // MAX_POINTS))]
            axis.plot(some, place + 0.14 * rng.uniform(-1, 1, len(some)), ".", ms=3, alpha=0.5, color=BLUE)
            if stat.avg_interval is not None:
                span = stat.avg_interval
                axis.plot([span.low, span.high], [place] * 2, color=ORANGE, lw=2.5, solid_capstyle="butt")
            axis.plot(stat.avg, place, "|", ms=15, mew=2.5, color=ORANGE)
        axis.set_yticks(range(len(names)), [labels[name] for name in reversed(names)])
        axis.set_xlabel("CSIM, %")
        axis.set_title(f"{alignment}, binary", fontsize=10)
        axis.grid(axis="x", alpha=0.3)
    axes[1].set_yticklabels([])
    figure.suptitle(textwrap.fill(report.label, LABEL_CHARS), fontsize=10)
    return plot_uri(figure)


def by_strokes(report: Report) -> str:
    """CSIM on presses that were not fitted, against the number of presses that were."""
    figure, axis = plot(1, 1, (6.4, 3.2))
    for name, colour in (("CCD-BSM", ORANGE), ("Bézier", BLUE)):
        counts = sorted({step.strokes for step in report.by_strokes if step.model == name})
        means = [np.mean([s.csim for s in report.by_strokes if (s.model, s.strokes) == (name, n)]) for n in counts]
        if counts:
            axis.plot(counts, means, "o-", ms=4, color=colour, label=f"{name} fitted")
    axis.set_xscale("log")
    axis.set_xticks(sorted({s.strokes for s in report.by_strokes}))
    axis.set_xticklabels([str(n) for n in sorted({s.strokes for s in report.by_strokes})])
    axis.minorticks_off()
    axis.set_xlabel("presses that were fitted")
    axis.set_ylabel("CSIM on all others, %")
    axis.set_title(f"mm, binary\n{textwrap.fill(report.label, LABEL_CHARS // 2)}", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend()
    return plot_uri(figure)


@dataclass(frozen=True, slots=True)
class Curve:
    """A training, from its folder: validation loss by step."""

    name: str
    steps: tuple[int, ...]
    losses: tuple[float, ...]


def read_curve(text: str) -> Curve:
    """Read `NAME=FOLDER`, a folder that `brushloop train` wrote. Raises `CalibrationError` if it holds no curve."""
    name, _, folder = text.partition("=")
    if not name or not folder:
        raise CalibrationError(f"--curves {text}", "expected NAME=FOLDER")
    path = Path(folder) / "validation.csv"
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_CURVE_BYTES).decode())))
        steps = tuple(int(row["step"]) for row in rows)
        losses = tuple(float(row["mse"]) for row in rows)
    except (KeyError, TypeError, ValueError):
        raise CalibrationError(str(path), "is not a table of validation losses (step, mse)") from None
    if not steps:
        raise CalibrationError(str(path), "holds no validation yet")
    return Curve(name, steps, losses)


def curves(given: Sequence[Curve]) -> str:
    """Validation losses of trained generators: the paper's figures 9 and 12."""
    figure, axis = plot(1, 1, (6.4, 3.2))
    for one in given:
        axis.semilogy(one.steps, one.losses, ".-", ms=4, label=one.name)
    axis.set_xlabel("step")
    axis.set_ylabel("validation loss (MSE)")
    axis.set_title("networks trained on exact images of stroke models", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend()
    return plot_uri(figure)


def samples(outcome: Outcome, shown: str) -> list[dict[str, Any]]:
    """The first capture of each cell, one model's prediction and their difference: the paper's figures 7 and 8."""
    figures: list[dict[str, Any]] = []
    for k in _first_of_cells(outcome, MAX_SAMPLES):
        row = outcome.rows[k]
        measured = row.press.measured
        size = "" if measured is None else f"{measured.length_mm:.1f} × {measured.breadth_mm:.1f} mm"
        csim, ssim = np.nan, np.nan
        if shown:
            csim, ssim = (100.0 * v for v in outcome.scores.one(k, shown, MM_BINARY))
        scores = f"CSIM {csim:.1f}, SSIM {ssim:.1f}" if np.isfinite(csim) else ""
        figures.append({"row": row, "size": size, "scores": scores, "images": triple(outcome, k, shown)})
    return figures


def side_by_side(outcome: Outcome, leave_out: Sequence[str]) -> dict[str, Any]:
    """Some captures next to the prediction of every candidate: the paper's figures 10 and 11."""
    chosen = _first_of_cells(outcome, MAX_CELLS)
    known = {one.name: one.label for group in outcome.candidates for one in group if one.name not in leave_out}
    lines: list[dict[str, Any]] = []
    for k in chosen:
        images = [predicted(outcome, k, name) for name in known]
        shown = ["" if image is None else _ink(image) for image in images]
        lines.append({"row": outcome.rows[k], "captured": _ink(captured_image(outcome, k)), "models": shown})
    return {"labels": list(known.values()), "lines": lines}


def of_one_cell(outcome: Outcome, names: Sequence[str]) -> list[tuple[str, str]]:
    """(label, image) of a capture of the middle cell, and of these candidates' predictions."""
    chosen = _first_of_cells(outcome, MAX_SAMPLES)
    if not chosen:
        return []
    k = chosen[len(chosen) // 2]
    labels = {one.name: one.label for one in outcome.candidates[outcome.rows[k].session]}
    images = [("captured", _ink(captured_image(outcome, k)))]
    for name in names:
        image = predicted(outcome, k, name)
        if image is not None:
            images.append((labels[name], _ink(image)))
    return images


def _first_of_cells(outcome: Outcome, most: int) -> list[int]:
    """The first capture of each cell; with more than `most` cells, of evenly spaced ones."""
    first = list(outcome.rows.first_of_each().values())
    count = min(len(first), most)
    return [first[n * (len(first) - 1) // max(count - 1, 1)] for n in range(count)]


def triple(outcome: Outcome, k: int, model: str) -> dict[str, str]:
    """Captured, predicted and difference image as data URIs; captured alone if the model does not predict the press."""
    captured, image = captured_image(outcome, k), predicted(outcome, k, model)
    if image is None:
        return {"captured": _ink(captured)}
    a, b = (np.asarray(one[ROWS] / 255.0, np.float32) for one in (captured, image))
    return {"captured": ink_uri(a), "predicted": ink_uri(b), "difference": overlay_uri(a, b)}


def predicted(outcome: Outcome, k: int, name: str) -> Pixels | None:
    """(128, 128) gray on the millimetre field, or None if the model does not predict this press."""
    row = outcome.rows[k]
    found = next((one for one in outcome.candidates[row.session] if one.name == name), None)
    if found is None:
        return None
    try:
        return found.predict(row.press.condition)[GRAY_MM]
    except DomainError:
        return None


def captured_image(outcome: Outcome, k: int) -> Pixels:
    """(128, 128) gray on the millimetre field."""
    return unpack(outcome.rows.pixels(k))[GRAY_MM]


def _ink(image: Pixels) -> str:
    return ink_uri(np.asarray(image[ROWS] / 255.0, np.float32))
