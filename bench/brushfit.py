"""How near a fitted brush comes to the ceiling from few strokes, and what choosing them saves; loopback rig.

The brushes are frozen (`bench.brushfit_brushes`). Presses come straight from `drivers.sim.brush`, each with a full load
of ink. Scores are CSIM of ink as 0 or 1 at 0.3 mm a pixel over cells that no training stroke came from; the ceiling is
the majority of the other nine presses of the same cell.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.brushfit_brushes import DEVELOPMENT, FROZEN
from bench.harness import Result, machine
from calibrate.fit.fit import Grid, Pressed, fit_presses
from calibrate.fit.heldout import RefittedBezier, image_of, predictor, refit_bezier
from calibrate.fit.stepwise import next_press
from drivers.sim.brush.brush import Brush, BrushSpec
from drivers.sim.brush.paper import Footprint
from model.fitted import FittedPress

PX_MM, SIZE_PX = 0.3, 128
LEFT_MM, TOP_MM = 29.1, 19.2
ROWS = slice(28, 100)
"""The fit looks at 10.8 mm to either side: no press is thicker."""
INKED = 0.3
CELLS = tuple((height, tilt) for height in (11.0, 13.0, 15.0, 17.0, 20.0) for tilt in (0.0, 5.0, 10.0))
REPEATS = 10
DESIGNS = {5: (0, 2, 7, 12, 14), 9: (0, 1, 2, 6, 7, 8, 12, 13, 14)}
"""Corners and middle; the shallowest, middle and deepest depth at every tilt."""
GOALS = {5: 1.5, 9: 1.0}
ADAPTIVE = (4, 5, 6, 8)
Images = NDArray[np.float32]


def grid() -> Grid:
    """Pixel centres around the point of touch."""
    centres = (np.arange(SIZE_PX) + 0.5) * PX_MM
    return Grid(np.asarray(centres - LEFT_MM, np.float64), np.asarray(TOP_MM - centres, np.float64))


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """`measure` over the first `n` frozen brushes (default all five)."""
    return measure(FROZEN[: len(FROZEN) if n is None else n], "frozen", seed)


def measure(brushes: Sequence[BrushSpec], called: str, seed: int) -> Sequence[Result]:
    """The gap to the ceiling in CSIM points from 5 and 9 strokes, and from strokes chosen one by one beside twice as
    many of the shuffled grid. Raises ValueError without a brush.

    ratio = the goal over the gap; the refitted Bezier's gap over ours; the shuffled grid's gap over ours.
    """
    if not brushes:
        raise ValueError("at least one brush is needed")
    gaps: dict[str, list[float]] = {}
    seconds: dict[int, list[float]] = {size: [] for size in DESIGNS}
    for spec in brushes:
        ink = draw(spec)
        for size, design in DESIGNS.items():
            rng = np.random.default_rng([seed, spec.seed, size])
            chosen = [(cell, int(rng.integers(REPEATS))) for cell in design]
            strokes = _pressed(ink, chosen)
            held = [k for k in range(len(CELLS)) if k not in design]
            began = time.perf_counter()
            fit = fit_presses(strokes, _cropped(), spec.radius_mm, spec.length_mm)
            seconds[size].append(time.perf_counter() - began)
            published = FittedPress(spec.radius_mm, spec.length_mm)
            gaps.setdefault(f"fitted.{size}", []).append(gap(ink, held, predictor(fit.press, grid())))
            bezier = refit_bezier([Pressed(CELLS[c][0], CELLS[c][1], ink[c, r]) for c, r in chosen], grid())
            gaps.setdefault(f"bezier.{size}", []).append(gap(ink, held, _image_of(bezier)))
            gaps.setdefault(f"uncalibrated.{size}", []).append(gap(ink, held, predictor(published, grid())))
        for size, (ours, shuffled) in adaptive(ink, spec, seed).items():
            gaps.setdefault(f"adaptive.{size}", []).append(ours)
            gaps.setdefault(f"shuffled.{2 * size}", []).append(shuffled)
    results: list[Result] = []
    for size, goal in GOALS.items():
        mine, peer, none = (gaps[f"{kind}.{size}"] for kind in ("fitted", "bezier", "uncalibrated"))
        where = (
            f"loopback rig, {len(brushes)} {called} brushes; gap of each {_list(mine)}; refitted Bezier {_list(peer)}; "
            f"uncalibrated {_list(none)}; fit {np.mean(seconds[size]):.1f} s; {machine()}"
        )
        mean, count = float(np.mean(mine)), len(brushes)
        worst = float(np.max(mine))
        name = f"brushfit.gap.{size}"
        results.append(Result(name, mean, "CSIM points", f"goal {goal:g} at most", goal / mean, count, seed, where))
        results.append(
            Result(f"{name}.worst", worst, "CSIM points", f"goal {goal:g} at most", goal / worst, count, seed, where)
        )
        results.append(
            Result(name, mean, "CSIM points", "a Bezier refitted", float(np.mean(peer)) / mean, count, seed, where)
        )
    for size in ADAPTIVE:
        mine, peer = gaps[f"adaptive.{size}"], gaps[f"shuffled.{2 * size}"]
        where = f"loopback rig; gap of each {_list(mine)}; shuffled grid with {2 * size} strokes {_list(peer)}"
        mean = float(np.mean(mine))
        results.append(
            Result(
                f"brushfit.adaptive.{size}",
                mean,
                "CSIM points",
                f"{2 * size} strokes of the shuffled grid",
                float(np.mean(peer)) / mean,
                len(brushes),
                seed,
                where,
            )
        )
    return results


def adaptive(ink: Images, spec: BrushSpec, seed: int) -> dict[int, tuple[float, float]]:
    """Strokes -> gap to the ceiling of strokes chosen one by one, and of twice as many of the shuffled grid.

    Both are judged on all cells, as the two train on different ones.
    """
    everywhere = list(range(len(CELLS)))
    rng = np.random.default_rng([seed, spec.seed])
    order = [(int(k) // REPEATS, int(k) % REPEATS) for k in rng.permutation(len(CELLS) * REPEATS)]
    found: dict[int, tuple[float, float]] = {}
    chosen: list[tuple[int, int]] = []
    state = FittedPress(spec.radius_mm, spec.length_mm)
    for size in range(1, max(ADAPTIVE) + 1):
        choice = next_press(state, [CELLS[c] for c, _ in chosen], CELLS, _cropped(), enough_points=0.0)
        assert choice.cell is not None
        chosen.append((CELLS.index(choice.cell), int(rng.integers(REPEATS))))
        state = fit_presses(_pressed(ink, chosen), _cropped(), spec.radius_mm, spec.length_mm).press
        if size in ADAPTIVE:
            other = fit_presses(_pressed(ink, order[: 2 * size]), _cropped(), spec.radius_mm, spec.length_mm)
            ours, shuffled = (gap(ink, everywhere, predictor(press, grid())) for press in (state, other.press))
            found[size] = (ours, shuffled)
    return found


def draw(spec: BrushSpec) -> Images:
    """(15 cells, 10 presses, 128, 128) coverage by ink."""
    brush = Brush(spec)
    out = np.empty((len(CELLS), REPEATS, SIZE_PX, SIZE_PX), np.float32)
    for c, (height, tilt) in enumerate(CELLS):
        for r in range(REPEATS):
            out[c, r] = on_field(brush.press(height, tilt, ink_load=1.0, press_seed=1000 * c + r))
    return out


def on_field(mark: Footprint) -> Images:
    """(128, 128) share of each pixel that is inked."""
    side = round(SIZE_PX * PX_MM * mark.px_per_mm)
    field = np.zeros((side, side), np.float32)
    column, row = (round(mm * mark.px_per_mm - at) for mm, at in zip((LEFT_MM, TOP_MM), mark.origin_px, strict=True))
    ink = (mark.density > INKED)[max(0, -row) : side - row, max(0, -column) : side - column]
    top, left = max(0, row), max(0, column)
    field[top : top + ink.shape[0], left : left + ink.shape[1]] = ink
    return np.asarray(cv2.resize(field, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA), np.float32)


def gap(ink: Images, cells: Sequence[int], predict: Callable[[float, float], NDArray[np.floating]]) -> float:
    """CSIM points by which predictions of these cells fall short of the ceiling."""
    short: list[float] = []
    for c in cells:
        seen = predict(*CELLS[c]) > 0.5
        truth = ink[c] > 0.5
        votes = truth.sum(axis=0)
        for one in truth:
            template = 2 * (votes - one) > REPEATS - 1
            short.append(_csim(template, one) - _csim(seen, one))
    return 100.0 * float(np.mean(short))


def _csim(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    norm = np.sqrt(float(np.count_nonzero(a)) * float(np.count_nonzero(b)))
    return float(np.count_nonzero(a & b)) / norm if norm > 0.0 else 0.0


def _image_of(bezier: RefittedBezier) -> Callable[[float, float], NDArray[np.floating]]:
    return lambda height, tilt: image_of(bezier.outline(height, tilt), grid())


def _pressed(ink: Images, chosen: Sequence[tuple[int, int]]) -> list[Pressed]:
    return [Pressed(*CELLS[c], ink[c, r][ROWS]) for c, r in chosen]


def _cropped() -> Grid:
    whole = grid()
    return Grid(whole.x_mm, whole.y_mm[ROWS])


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def main(arguments: Sequence[str]) -> None:
    """`python -m bench.brushfit [--development]`: the frozen brushes, or those that the fit is developed on."""
    develop = "--development" in arguments
    for line in measure(DEVELOPMENT, "development", 0) if develop else run():
        sys.stdout.write(f"# {line.conditions}\n{line.to_line()}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
