"""Dragged strokes of real ink predicted along the commanded path: bristle lag beside circle stamps.

Of the big brush, 40 strokes are fixed as a test before anything is fitted (`SPLIT_SEED`); the rest is for training.
`bench.realink_sessions` predicts one session of the small brush from another. Scores are CSIM and IoU of ink as 0 or 1
at 2.5 px/mm, raw (where the command put it) and shift-searched (best shift within 2.4 mm).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import BenchError, Result, machine
from bench.realink_sessions import SESSION_SPLITS, measure_sessions
from bench.realink_strokes import PX_PER_MM, Strokes, load, region
from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.drags.fit import INK_ABOVE, SPREAD_MM, Residual, captured_distance, fit_drags, threshold
from brushloop.calibrate.drags.predict import STAMP_ABOVE, STAMP_SPREAD_MM
from brushloop.model.drag import ink as chance

SPLIT_SEED = 0
TEST = 40
SIZES = (10, 20, 40, 80, 147)
SUBSETS = 5
GOALS = {20: (0.845, 0.735), 147: (0.86, 0.76)}
SHIFT_PX = 6
QUICK_SIZES = (20,)
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scores:
    """Means over the test strokes."""

    csim: float
    iou: float
    shifted: float
    gray: float
    """CSIM of the chance of ink itself, not of ink as 0 or 1."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Mean of `n` random subsets (default 5) for each size. Empty, with a line on stderr, where the strokes are not at
    hand.

    ratio = ours over circle stamps, then over the goal where there is one.
    """
    subsets = SUBSETS if n is None else n
    if subsets < 1:
        raise ValueError(f"n = {n}: at least one subset is needed")
    try:
        strokes = load()
    except BenchError as error:
        sys.stderr.write(f"realink: skipped: {error}\n")
        return []
    within = [result for size in SIZES for result in measure(strokes, size, subsets, seed)]
    return [*within, *measure_sessions(SESSION_SPLITS if n is None else n, seed)]


def measure(strokes: Strokes, size: int, subsets: int, seed: int) -> list[Result]:
    """The results of one number of training strokes."""
    found = compare(strokes, size, 1 if size == max(SIZES) else subsets, seed)
    ours, circles, placed = (found[key] for key in ("lag", "circles", "lag+page"))
    where = (
        f"real ink, {TEST} test strokes, split seed {SPLIT_SEED}; ours {_words(ours)}, sd of CSIM "
        f"{ours[:, 0].std():.3f}; circle stamps {_words(circles)}; lag alone {_words(found['lag-only'])}; with "
        f"the place on the page {_words(placed)}; fit and prediction {found['seconds'].mean():.1f} s; {machine()}"
    )
    results: list[Result] = []
    for column, what in enumerate(("csim", "iou")):
        name = f"realink.{what}.{size}"

        def line(suffix: str, scores: Floats, peer: str, against: float, name: str = name, at: int = column) -> Result:
            mean = float(scores[:, at].mean())
            return Result(name + suffix, mean, "of 1", peer, mean / against, len(scores), seed, where)

        results.append(line("", ours, "circle stamps", float(circles[:, column].mean())))
        if size in GOALS:
            goal = GOALS[size][column]
            results.append(line("", ours, f"goal {goal:g}", goal))
            results.append(line(".page", placed, f"goal {goal:g}", goal))
    return results


def split(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(training, test) strokes by index; always the same."""
    order = np.random.default_rng(SPLIT_SEED).permutation(count)
    return order[TEST:], np.sort(order[:TEST])


def compare(strokes: Strokes, size: int, subsets: int, seed: int) -> dict[str, Floats]:
    """Scores of every contestant, (subsets, 4) each, and the seconds of our fits, (subsets,)."""
    train, test = split(len(strokes.paths))
    captured = captured_distance(strokes.ink, 1.0 / PX_PER_MM)
    found: dict[str, list[Scores]] = {key: [] for key in ("lag", "lag-only", "lag+page", "circles")}
    seconds: list[float] = []
    for k in range(subsets):
        chosen = train if size >= len(train) else np.random.default_rng([seed, size, k]).permutation(train)[:size]
        began = time.perf_counter()
        alone, corrected, above = predict(strokes, captured, chosen, test)
        seconds.append(time.perf_counter() - began)
        found["lag"].append(score(strokes, test, corrected, above))
        found["lag-only"].append(score(strokes, test, alone))
        _, placed, above = predict(strokes, captured, chosen, test, page=True)
        found["lag+page"].append(score(strokes, test, placed, above))
        found["circles"].append(circles(strokes, chosen, test))
    table = {key: np.array([[s.csim, s.iou, s.shifted, s.gray] for s in each]) for key, each in found.items()}
    return table | {"seconds": np.array(seconds)}


def predict(
    strokes: Strokes,
    captured: Floats,
    chosen: NDArray[np.int64],
    test: NDArray[np.int64],
    *,
    page: bool = False,
) -> tuple[Floats, Floats, float]:
    """Probabilities of ink at the test strokes, by the fitted drag model alone and with its learned correction; and the
    probability above which a pixel counts as ink, chosen on the training strokes."""
    rows, columns = (slice(s.start, s.stop, 2) for s in region(strokes)[1:])
    place = strokes.place if page else np.zeros((len(strokes.paths), 0))
    paths = [strokes.paths[k] for k in chosen]
    x_mm, y_mm = strokes.x_mm, strokes.y_mm
    fit = fit_drags(paths, strokes.ink[chosen][:, rows, columns], x_mm[columns], y_mm[rows], place[chosen])
    there = fit.distance([strokes.paths[k] for k in test], x_mm, y_mm, place[test])
    here = fit.distance(paths, x_mm, y_mm, place[chosen])
    missed = Residual.fit(strokes.commands[chosen], here, captured[chosen])
    above = threshold(strokes.commands[chosen], here, captured[chosen])
    corrected = missed.add(strokes.commands[test], there)
    return chance(there, SPREAD_MM), chance(corrected, SPREAD_MM), above


def circles(strokes: Strokes, chosen: NDArray[np.int64], test: NDArray[np.int64]) -> Scores:
    """Discs at the tip all along the commanded path, fitted to the chosen strokes: radius by depth, a shift by depth,
    and how far along the path the radius settles; no leash."""
    rows, columns = (slice(s.start, s.stop, 2) for s in region(strokes)[1:])
    paths, spread = [strokes.paths[k] for k in chosen], STAMP_SPREAD_MM
    x_mm, y_mm = strokes.x_mm[columns], strokes.y_mm[rows]
    fit = fit_drags(paths, strokes.ink[chosen][:, rows, columns], x_mm, y_mm, lag=False, spread_mm=spread)
    here = chance(fit.distance(paths, strokes.x_mm, strokes.y_mm), spread)
    above = max(STAMP_ABOVE, key=lambda a: score(strokes, chosen, here, a).csim)
    there = fit.distance([strokes.paths[k] for k in test], strokes.x_mm, strokes.y_mm)
    return score(strokes, test, chance(there, spread), above)


def score(strokes: Strokes, test: NDArray[np.int64], chances: NDArray[np.floating], above: float = INK_ABOVE) -> Scores:
    """Means over the test strokes of the chances of ink, (n, rows, columns)."""
    ink, truths = chances > above, strokes.ink[test]
    csim, iou = binary_scores(ink, truths).mean(axis=0)
    rows: list[tuple[float, float]] = []
    for seen, one, truth in zip(chances, ink, truths, strict=True):
        padded = np.pad(one.astype(np.float32), SHIFT_PX)
        overlap = cv2.matchTemplate(padded, truth.astype(np.float32), cv2.TM_CCORR)
        norm = max(1.0, float(np.sqrt(np.count_nonzero(one) * np.count_nonzero(truth))))
        gray = float(seen[truth].sum() / (np.linalg.norm(seen) * np.sqrt(np.count_nonzero(truth)) + 1e-9))
        rows.append((float(overlap.max()) / norm, gray))
    shifted, gray = np.mean(rows, axis=0)
    return Scores(float(csim), float(iou), float(shifted), float(gray))


def _words(scores: Floats) -> str:
    csim, iou, shifted, gray = scores.mean(axis=0)
    return f"{csim:.3f} / {iou:.3f} (shift {shifted:.3f}, gray {gray:.3f})"


def main(arguments: Sequence[str]) -> None:
    """`python -m bench.realink [--quick | SUBSETS [SIZE...]]`: prints each size as soon as it is measured;
    `--sessions [SPLITS]` measures only one session against the other."""
    quick = "--quick" in arguments
    numbers = [int(word) for word in arguments if not word.startswith("--")]
    if "--sessions" in arguments:
        splits = numbers[0] if numbers else SESSION_SPLITS
        _print(measure_sessions(splits, 0))
        return
    subsets = numbers[0] if numbers else 2 if quick else SUBSETS
    try:
        strokes = load()
    except BenchError as error:
        sys.stderr.write(f"realink: skipped: {error}\n")
        return
    for size in numbers[1:] or (QUICK_SIZES if quick else SIZES):
        _print(measure(strokes, size, subsets, 0))
    if not numbers[1:] and not quick:
        _print(measure_sessions(SESSION_SPLITS, 0))


def _print(results: Sequence[Result]) -> None:
    for before, result in zip([None, *results], results, strict=False):
        if before is None or before.conditions != result.conditions:
            sys.stdout.write(f"# {result.conditions}\n")
        sys.stdout.write(result.to_line() + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
