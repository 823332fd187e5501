"""How well twins predict cells that they have not seen, and how well they repeat themselves.

Brushes: the five frozen ones of the loopback rig, which the twin's own simulator pressed, and two of an independent
bristle simulation. Nothing is a result on paper.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

from bench.brushfit_brushes import FROZEN
from bench.brushfit_presses import BRISTLE_SETS, CELLS, BrushPresses, bristles, simulated
from bench.harness import BenchError, Result
from brushloop.calibrate.fit.heldout import BEZIER
from brushloop.calibrate.stats import CEILING
from brushloop.sessions.terminal import shown
from brushloop.twin.run import TWIN, fit_twin, workers

REPEATS = 3
"""Presses of each cell: 45 in all."""
GAP_POINTS, REPEAT_POINTS = 1.5, 1.0
CONFIDENCE = 0.95
TRUTH = {f"frozen-{k}": spec for k, spec in enumerate(FROZEN, 1)}
"""Constants of the brushes that the simulator pressed, by name."""
BRUSHES = (*TRUTH, *BRISTLE_SETS)


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Fit a twin to 45 presses of each of the first `n` brushes (all seven by default) and score it.

    value = CSIM points below the ceiling, or between the agreement of two captures and of two presses of the twin; for
    a brush whose constants are known, also the share of the intervals that hold them.
    """
    return [result for name in BRUSHES[:n] for result in measure(name, seed)]


def measure(name: str, seed: int = 0) -> Sequence[Result]:
    """The results of one of `BRUSHES`; none, and a line on stderr, if its presses are not at hand."""
    try:
        brush = simulated(TRUTH[name], name, REPEATS) if name in TRUTH else bristles(name)
    except BenchError as error:
        sys.stderr.write(f"twin: {error}\n")
        return []
    return list(_scored(brush, seed))


def _scored(brush: BrushPresses, seed: int) -> Iterator[Result]:
    strokes = brush.strokes([(c, r) for c in range(len(CELLS)) for r in range(min(REPEATS, brush.ink.shape[1]))])
    with workers() as pool, shown() as progress:
        twin = fit_twin(strokes, brush.grid, brush.radius_mm, brush.length_mm, pool, progress)
    csim = {row.model: row.csim for row in twin.held_out}
    gap = csim[CEILING] - csim[TWIN]
    where = f"simulated; ceiling {csim[CEILING]:.2f}, twin {csim[TWIN]:.2f}, refitted Bezier {csim[BEZIER]:.2f} %"
    independent = brush.name in BRISTLE_SETS
    goal = csim[CEILING] - csim[BEZIER] if independent else GAP_POINTS
    peer = "the refitted Bezier's gap" if independent else f"goal {GAP_POINTS:g} at most"
    yield Result(f"twin.gap.{brush.name}", gap, "CSIM points", peer, goal / max(gap, 0.01), len(strokes), seed, where)
    if twin.spread is not None:
        off = abs(twin.spread.captured_percent - twin.spread.twin_percent)
        words = f"simulated; two presses of a cell: {twin.spread.captured_percent:.2f} % as captured"
        yield Result(
            f"twin.repeats.{brush.name}", off, "CSIM points", f"goal {REPEAT_POINTS:g} at most",
            REPEAT_POINTS / max(off, 0.01), len(strokes), seed, f"{words}, twin {twin.spread.twin_percent:.2f} %",
        )  # fmt: skip
    if brush.name in TRUTH:
        # a brush bows by bow_mm times a draw of its individual, which the twin does not have
        known = [one for one in twin.estimates if one.determined and one.constant.name != "bow_mm"]
        held = [one.low <= getattr(TRUTH[brush.name], one.constant.name) <= one.high for one in known]
        share = sum(held) / max(len(held), 1)
        yield Result(
            f"twin.intervals.{brush.name}", 100.0 * share, "%", f"{100.0 * CONFIDENCE:g}", share / CONFIDENCE,
            len(held), seed, f"simulated; {sum(held)} of {len(held)} intervals hold the constant of the captured brush",
        )  # fmt: skip


def main(arguments: Sequence[str]) -> None:
    """`python -m bench.twin [BRUSH ...]`: each of these of `BRUSHES`, or all, printed as soon as it is measured."""
    if unknown := [name for name in arguments if name not in BRUSHES]:
        sys.exit(f"unknown: {', '.join(unknown)}; known: {', '.join(BRUSHES)}")
    for name in arguments or BRUSHES:
        for result in measure(name):
            sys.stdout.write(f"# {result.conditions}\n{result.to_line()}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
