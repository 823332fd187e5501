"""How many presses a brush needs by four rules: the shuffled grid, two fixed designs, and each press chosen by a fit.

Ten brushes, all simulated: the frozen five of the loopback rig, two of an independent bristle simulation, and one of
each made-up family that the prior does not hold. No brush is fitted with a prior that holds its own family. A draw has
its own order of the presses of each cell, which is the same for all rules: common random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from bench.adaptive_choice import d_optimal, most_useful
from bench.brushfit import DESIGN
from bench.brushfit_brushes import FROZEN
from bench.brushfit_families import BRUSHES, FAMILIES, made_up
from bench.brushfit_presses import BRISTLE_SETS, CELLS, REPEATS, BrushPresses, Chosen, bristles, grid, simulated
from bench.brushfit_prior import BRISTLE, RIG
from bench.harness import Result
from calibrate.fit.fit import fit_presses
from calibrate.fit.heldout import predictor
from calibrate.fit.prior import Prior, learned
from model.fitted import FittedPress

DRAWS = 20
GOAL_POINTS = 1.5
GOAL_SHARE = 0.7
"""Share of the shuffled presses that choosing each press may need."""
LEAST, MOST = 2, 12
Rule = Callable[[FittedPress, Chosen, int], int]
"""The next cell after a fit to these presses, in the draw of that number."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Presses until the mean gap to the ceiling over `n` draws (default 20) is 1.5 CSIM points, over all 15 cells.

    The number is interpolated between the last two; 12 counts for a brush that does not get there. Raises BenchError
    without the bristle sets.
    """
    draws = DRAWS if n is None else n
    if draws < 1:
        raise ValueError(f"n = {n}: at least one draw is needed")
    found: dict[str, dict[str, float]] = {}
    for brush, prior in brushes(seed):
        for name, rule in rules(brush, prior, seed).items():
            found.setdefault(name, {})[brush.name] = needed(rule, brush, prior, draws, seed)
    means = {name: float(np.mean(list(presses.values()))) for name, presses in found.items()}
    results: list[Result] = []
    for name, presses in found.items():
        share = means[name] / means["shuffled"]
        peer, ratio = ("goal 0.7 of the shuffled", GOAL_SHARE) if name == "adaptive" else ("the shuffled grid", 1.0)
        each = ", ".join(f"{brush} {count:.1f}" for brush, count in presses.items())
        where = f"simulated; {100 * share:.0f} % of the shuffled presses; {each}"
        results.append(
            Result(f"adaptive.presses.{name}", means[name], "presses", peer, ratio / share, draws, seed, where)
        )
    return results


def rules(brush: BrushPresses, prior: Prior, seed: int) -> dict[str, Rule]:
    """The rules to compare for a brush."""
    d_design = d_optimal(prior, brush.radius_mm, brush.length_mm, brush.grid, MOST)

    def shuffled(fit: FittedPress, done: Chosen, draw: int) -> int:
        return int(np.random.default_rng([seed, 2, draw]).permutation(len(CELLS))[len(done)])

    def chosen(fit: FittedPress, done: Chosen, draw: int) -> int:
        return most_useful(fit, prior, [cell for cell, _ in done], brush.grid)

    return {
        "shuffled": shuffled,
        "d-optimal": lambda fit, done, draw: d_design[len(done)],
        "design": lambda fit, done, draw: DESIGN[len(done)],
        "adaptive": chosen,
    }


def brushes(seed: int) -> Iterator[tuple[BrushPresses, Prior]]:
    """The ten brushes, each with a prior without its family."""
    for number, spec in enumerate(FROZEN, 1):
        yield simulated(spec, f"frozen {number}"), learned((RIG,))
    for name in BRISTLE_SETS:
        yield bristles(name), learned((BRISTLE,))
    for family in FAMILIES:
        yield unsteady(family, seed), learned((family,))


def unsteady(family: str, seed: int) -> BrushPresses:
    """A made-up brush that is not in the prior, whose presses differ by 5 % of width and length and .3 mm of place."""
    brush = made_up(family, BRUSHES)
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    ink = np.empty((len(CELLS), REPEATS, len(grid().y_mm), len(grid().x_mm)), np.float32)
    for c, cell in enumerate(CELLS):
        for r in range(REPEATS):
            wide, long, off = rng.normal(size=3)
            one = replace(
                brush,
                half_mm=brush.half_mm * (1.0 + 0.05 * wide),
                reach_mm=brush.reach_mm * (1.0 + 0.05 * long),
                place_mm=brush.place_mm + 0.3 * off,
            )
            ink[c, r] = one.press(*cell, grid()).ink
    return BrushPresses(f"{family} {BRUSHES + 1}", brush.radius_mm, brush.length_mm, grid(), ink)


def needed(rule: Rule, brush: BrushPresses, prior: Prior, draws: int, seed: int) -> float:
    """Presses until the gap, mean over the draws, is `GOAL_POINTS`."""
    rng = np.random.default_rng([seed, 1])
    orders = [[rng.permutation(brush.ink.shape[1]) for _ in CELLS] for _ in range(draws)]
    done: list[list[tuple[int, int]]] = [[] for _ in range(draws)]
    fits = [FittedPress(brush.radius_mm, brush.length_mm, prior.values)] * draws
    before = np.inf
    for count in range(1, MOST + 1):
        for k, chosen in enumerate(done):
            cell = rule(fits[k], chosen, k)
            turn = sum(c == cell for c, _ in chosen) % brush.ink.shape[1]
            chosen.append((cell, int(orders[k][cell][turn])))
            strokes = brush.strokes(chosen)
            fits[k] = fit_presses(strokes, brush.grid, brush.radius_mm, brush.length_mm, prior=prior).press
        if count < LEAST:
            continue
        gap = float(np.mean([brush.gap(range(len(CELLS)), predictor(fit, brush.grid)) for fit in fits]))
        if gap <= GOAL_POINTS:
            return count if count == LEAST else count - (GOAL_POINTS - gap) / (before - gap)
        before = gap
    return float(MOST)
