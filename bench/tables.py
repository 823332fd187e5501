"""Tables 1 and 2 over the frozen brushes: calibrated models on cells that they have not seen, beside their peers.

Each brush presses the paper's 15 cells three times (the simulated brush, photographed at 10 px/mm and imported, so the
reports say `imported photographs`). The commands are the ones that a user gives: train once, then fit and validate.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.brushfit_brushes import FROZEN
from bench.harness import BenchError, Result, machine
from bench.press_sessions import CELLS, Presses, session
from bench.processes import brushloop
from brushloop.calibrate.compare.ceiling import CEILING
from brushloop.calibrate.compare.field import Alignment, Tone
from brushloop.calibrate.validate.candidates import BEZIER_REFITTED, FITTED_HELD_OUT, GENERATOR_HELD_OUT
from brushloop.calibrate.validate.report.data import Report, load_report

REPEATS, TRAIN_STEPS, TUNE_STEPS = 3, 3000, 300
PUBLISHED = ("ccd-bsm", "bezier", "ellipse", "line", "circle")
"""In the paper's order."""
ORDER_POINTS = 0.1
"""Averages that differ by less count as equal."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """CSIM of the first `n` frozen brushes (default all five), binary, in both alignments.

    value = points below the ceiling (`calibrate.compare.ceiling`); ratio = the refitted Bezier's gap over ours.
    """
    brushes = FROZEN[: len(FROZEN) if n is None else n]
    if not brushes:
        raise ValueError(f"n = {n}: at least one brush is needed")
    out: list[Result] = []
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        brushloop(
            *("train", "--target", "anchored", "--out", str(under / "generator")),
            *("--steps", str(TRAIN_STEPS), "--seed", str(seed)),
        )
        for number, spec in enumerate(brushes, 1):
            count = REPEATS * len(CELLS)
            place = session(under, f"brush-{number}", Presses(count, seed, spec, count))
            brushloop("fit", str(place))
            generator = ("--generator", str(under / "generator" / "generator.safetensors"))
            report = under / f"report-{number}"
            brushloop("validate", str(place), "--out", str(report), *generator, "--tune", str(TUNE_STEPS))
            out += _figures(number, load_report(report / "report.json"), count, seed)
    return out


def _figures(number: int, report: Report, count: int, seed: int) -> list[Result]:
    out: list[Result] = []
    for alignment in Alignment:
        average = {
            name: _average(report, name, alignment)
            for name in (CEILING, FITTED_HELD_OUT, GENERATOR_HELD_OUT, BEZIER_REFITTED, *PUBLISHED)
        }
        top, peer = average[CEILING], average[BEZIER_REFITTED]
        values = [average[name] for name in PUBLISHED]
        held = all(a > b - ORDER_POINTS for a, b in itertools.pairwise(values))
        averages = ", ".join(f"{name} {value:.1f}" for name, value in average.items())
        words = (
            f"brush {number}, {alignment}, {count} presses, the paper's order {'holds' if held else 'does not hold'}"
        )
        where = f"simulated brush (loopback rig): {words}: {averages}; {machine()}"
        for name in (FITTED_HELD_OUT, GENERATOR_HELD_OUT):
            gap = top - average[name]
            ratio = (top - peer) / gap if gap > 0.0 else float("inf")
            label = f"tables.{number}.{alignment}.{name}"
            out.append(Result(label, gap, "points", "the refitted Bezier's gap", ratio, count, seed, where))
    return out


def _average(report: Report, model: str, alignment: Alignment) -> float:
    stat = report.stat(model, alignment, Tone.BINARY, "csim")
    if stat is None:
        raise BenchError(f"the report has no {model}")
    return stat.avg
