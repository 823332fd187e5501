"""How close a fitted brush comes to the ceiling with few strokes.

Brushes: the five frozen ones of the loopback rig, and two of an independent bristle simulation. Scores are CSIM of ink
as 0 or 1 at 0.3 mm a pixel over cells that no training stroke came from; the ceiling is that of
`calibrate.stats`. Nothing of a brush's own family is in the prior that it is fitted with.

Cells: the first of the fixed design (`calibrate.spread`), or any. Each draw takes other presses of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from bench.brushfit_brushes import FROZEN
from bench.brushfit_presses import BRISTLE_SETS, CELLS, BrushPresses, Chosen, bristles, simulated
from bench.brushfit_prior import BRISTLE
from bench.harness import BenchError, Result, machine
from brushloop.calibrate.fit.captures import Grid
from brushloop.calibrate.fit.fit import fit_presses
from brushloop.calibrate.fit.heldout import RefittedBezier, image_of, predictor, refit_bezier
from brushloop.calibrate.fit.prior import Prior, learned
from brushloop.calibrate.spread import spread_out
from brushloop.model.fitted import FittedPress

DRAWS = 10
DESIGN = tuple(CELLS.index(cell) for cell in spread_out(sorted({h for h, _ in CELLS}), sorted({a for _, a in CELLS})))
GOALS = {5: 1.5, 9: 1.0, 12: 1.0}
FULL = 4
"""Presses of a cell in a full fit."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """`measure` with `n` draws (default 10) over the frozen brushes and the bristle sets, where these are at hand."""
    draws = DRAWS if n is None else n
    if draws < 1:
        raise ValueError(f"n = {n}: at least one draw is needed")
    brushes = [(simulated(spec, f"frozen {k}"), learned()) for k, spec in enumerate(FROZEN, 1)]
    try:
        brushes += [(bristles(name), learned((BRISTLE,))) for name in BRISTLE_SETS]
    except BenchError as error:
        sys.stderr.write(f"brushfit: {error}: scored on the loopback rig only\n")
    return measure(brushes, draws, seed)


def measure(brushes: Sequence[tuple[BrushPresses, Prior]], draws: int, seed: int) -> Sequence[Result]:
    """The gap to the ceiling in CSIM points from few strokes, by design and at random, and from all other cells.

    ratio = the goal over the gap, or a peer's gap over ours. Raises ValueError without a brush.
    """
    if not brushes:
        raise ValueError("at least one brush is needed")
    results: list[Result] = []
    for size, goal in GOALS.items():
        for cells in ("design", "any"):
            gaps = [[few(one, prior, _draw(one, cells, size, k, seed)) for k in range(draws)] for one, prior in brushes]
            results += _gap_results(f"brushfit.gap.{size}.{cells}", [b for b, _ in brushes], gaps, goal, seed)
        peers = [bezier(one, _draw(one, "design", size, 0, seed)) for one, _ in brushes]
        ours = [few(one, prior, _draw(one, "design", size, 0, seed)) for one, prior in brushes]
        published = _list([uncalibrated(brush) for brush, _ in brushes])
        where = f"simulated; refitted Bezier of each {_list(peers)}; uncalibrated {published}"
        ratio = float(np.mean(peers) / np.mean(ours))
        results.append(
            Result(
                f"brushfit.gap.{size}", float(np.mean(ours)), "CSIM points", "a Bezier refitted", ratio, 1, seed, where
            )
        )
    full = [all_others(one, prior) for one, prior in brushes]
    where = f"simulated; {', '.join(b.name for b, _ in brushes)}: each cell from all others {_list(full)}"
    worst = float(np.max(full))
    results.append(
        Result("brushfit.gap.full", float(np.mean(full)), "CSIM points", "goal 1 at most", 1.0 / worst, 1, seed, where)
    )
    return results


def few(brush: BrushPresses, prior: Prior, chosen: Chosen) -> float:
    """The gap over the cells without a chosen stroke."""
    press = _fitted(brush, prior, chosen)
    used = {cell for cell, _ in chosen}
    return brush.gap([c for c in range(len(CELLS)) if c not in used], predictor(press, brush.grid))


def all_others(brush: BrushPresses, prior: Prior) -> float:
    """The mean gap of each cell from four presses of every other one."""
    gaps: list[float] = []
    for held in range(len(CELLS)):
        chosen = [(c, r) for c in range(len(CELLS)) if c != held for r in range(FULL)]
        gaps.append(brush.gap([held], predictor(_fitted(brush, prior, chosen), brush.grid)))
    return float(np.mean(gaps))


def bezier(brush: BrushPresses, chosen: Chosen) -> float:
    """The gap of a refitted Bezier over the cells without a chosen stroke."""
    used = {cell for cell, _ in chosen}
    fitted = refit_bezier(brush.strokes(chosen), brush.grid)
    return brush.gap([c for c in range(len(CELLS)) if c not in used], _image_of(fitted, brush.grid))


def uncalibrated(brush: BrushPresses) -> float:
    """The gap of CCD-BSM as published over all cells."""
    published = FittedPress(brush.radius_mm, brush.length_mm)
    return brush.gap(range(len(CELLS)), predictor(published, brush.grid))


def _draw(brush: BrushPresses, cells: str, size: int, number: int, seed: int) -> Chosen:
    """Strokes of a draw: the cells of the design or any, and one press of each."""
    rng = np.random.default_rng([seed, number, size, sum(brush.name.encode())])
    chosen = DESIGN[:size] if cells == "design" else rng.permutation(len(CELLS))[:size]
    return [(int(c), int(rng.integers(brush.ink.shape[1]))) for c in chosen]


def _gap_results(
    name: str, brushes: Sequence[BrushPresses], gaps: Sequence[Sequence[float]], goal: float, seed: int
) -> Sequence[Result]:
    means, worst = [float(np.mean(g)) for g in gaps], [float(np.max(g)) for g in gaps]
    where = (
        f"simulated; {', '.join(b.name for b in brushes)}: mean {_list(means)}; worst draw {_list(worst)}; {machine()}"
    )
    draws = len(gaps[0])
    return [
        Result(f"{name}{suffix}", value, "CSIM points", f"goal {goal:g} at most", goal / value, draws, seed, where)
        for suffix, value in (("", float(np.mean(means))), (".worst-brush", max(means)), (".worst-draw", max(worst)))
    ]


def _fitted(brush: BrushPresses, prior: Prior, chosen: Chosen) -> FittedPress:
    return fit_presses(brush.strokes(chosen), brush.grid, brush.radius_mm, brush.length_mm, prior=prior)


def _image_of(bezier: RefittedBezier, grid: Grid) -> Callable[[float, float], NDArray[np.floating]]:
    return lambda height, tilt: image_of(bezier.outline(height, tilt), grid)


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
