"""Dragged strokes of real ink predicted along the commanded path: bristle lag beside circle stamps and a network.

40 strokes are fixed as a test before anything is fitted (`SPLIT_SEED`); the rest is for training. Scores are CSIM and
IoU of ink as 0 or 1 at 2.5 px/mm, raw (where the command put it) and shift-searched (best shift within 2.4 mm).
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
from bench.realink_network import train_and_predict
from bench.realink_strokes import Strokes, captured_distance, load
from calibrate.drags.fit import INK_ABOVE, Residual, chance, fit_drags

SPLIT_SEED = 0
TEST = 40
SIZES = (10, 20, 40, 80, 147)
SUBSETS = 5
GOALS = {20: (0.83, 0.71), 147: (0.86, 0.76)}
SCALES = np.array([30.0, 20.0, 0.6, 15.0])
"""Of length, bend, z and tilt, over which what the lag model misses stays alike; chosen on training strokes."""
SHIFT_PX = 6
CROP_MM = (-16.0, 64.0, 32.0)
NETWORK_STEPS = 500
CIRCLE_SPREAD_MM = 1.5
CIRCLE_ABOVE = (0.22, 0.26, 0.3, 0.34, 0.38, 0.42)
"""Circles predict edges less well than stamps do. They get an edge spread of their own, and the probability above which
a pixel counts as ink that suits them best on the training strokes."""
QUICK_SIZES, QUICK_STEPS = (20,), 120
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
    """Mean of `n` random subsets (default 5) for each size; the network is trained once a size, as it is slow, and
    compared on that subset. Empty, with a line on stderr, where the strokes are not at hand.

    ratio = ours over circle stamps, then over the network, then over the goal where there is one.
    """
    subsets = SUBSETS if n is None else n
    if subsets < 1:
        raise ValueError(f"n = {n}: at least one subset is needed")
    try:
        strokes = load()
    except BenchError as error:
        sys.stderr.write(f"realink: skipped: {error}\n")
        return []
    return [result for size in SIZES for result in measure(strokes, size, subsets, seed)]


def measure(strokes: Strokes, size: int, subsets: int, seed: int, network_steps: int = NETWORK_STEPS) -> list[Result]:
    """The results of one number of training strokes."""
    found = compare(strokes, size, 1 if size == max(SIZES) else subsets, seed, network_steps)
    ours, circles, network, placed = (found[key] for key in ("lag", "circles", "network", "lag+page"))
    where = (
        f"real ink, {TEST} test strokes, split seed {SPLIT_SEED}; ours {_words(ours)}, sd of CSIM "
        f"{ours[:, 0].std():.3f}; circle stamps {_words(circles)}; FRIDA-shaped network, first subset only, "
        f"{_words(network)}, at most {network_steps} steps; lag alone {_words(found['lag-only'])}; with the place on "
        f"the page {_words(placed)}; fit and prediction {found['seconds'].mean():.1f} s; {machine()}"
    )
    results: list[Result] = []
    for column, what in enumerate(("csim", "iou")):
        name = f"realink.{what}.{size}"

        def line(suffix: str, scores: Floats, peer: str, against: float, name: str = name, at: int = column) -> Result:
            mean = float(scores[:, at].mean())
            return Result(name + suffix, mean, "of 1", peer, mean / against, len(scores), seed, where)

        results.append(line("", ours, "circle stamps", float(circles[:, column].mean())))
        same = ours[: len(network)]
        results.append(line(".first", same, "a network of FRIDA's shape", float(network[:, column].mean())))
        if size in GOALS:
            goal = GOALS[size][column]
            results.append(line("", ours, f"goal {goal:g}", goal))
            results.append(line(".page", placed, f"goal {goal:g}", goal))
    return results


def split(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(training, test) strokes by index; always the same."""
    order = np.random.default_rng(SPLIT_SEED).permutation(count)
    return order[TEST:], np.sort(order[:TEST])


def compare(
    strokes: Strokes, size: int, subsets: int, seed: int, network_steps: int = NETWORK_STEPS
) -> dict[str, Floats]:
    """Scores of every contestant, (subsets, 4) each, and the seconds of our fits, (subsets,)."""
    train, test = split(len(strokes.paths))
    captured = captured_distance(strokes.ink)
    found: dict[str, list[Scores]] = {key: [] for key in ("lag", "lag-only", "lag+page", "circles", "network")}
    seconds: list[float] = []
    for k in range(subsets):
        chosen = train if size >= len(train) else np.random.default_rng([seed, size, k]).permutation(train)[:size]
        began = time.perf_counter()
        alone, corrected = predict(strokes, captured, chosen, test)
        seconds.append(time.perf_counter() - began)
        found["lag"].append(score(strokes, test, corrected))
        found["lag-only"].append(score(strokes, test, alone))
        found["lag+page"].append(score(strokes, test, predict(strokes, captured, chosen, test, page=True)[1]))
        found["circles"].append(circles(strokes, chosen, test))
        if k == 0:
            region = _region(strokes)
            seen = train_and_predict(
                strokes.commands[chosen], strokes.ink[chosen][region], strokes.commands[test], seed, network_steps
            )
            whole = np.zeros((len(test), *strokes.ink.shape[1:]))
            whole[region] = seen
            found["network"].append(score(strokes, test, whole))
    table = {key: np.array([[s.csim, s.iou, s.shifted, s.gray] for s in each]) for key, each in found.items()}
    return table | {"seconds": np.array(seconds)}


def predict(
    strokes: Strokes,
    captured: Floats,
    chosen: NDArray[np.int64],
    test: NDArray[np.int64],
    *,
    page: bool = False,
) -> tuple[Floats, Floats]:
    """The chance of ink at the test strokes: of the fitted drag model, and corrected by what it misses."""
    rows, columns = (slice(s.start, s.stop, 2) for s in _region(strokes)[1:])
    place = strokes.place if page else np.zeros((len(strokes.paths), 0))
    paths = [strokes.paths[k] for k in chosen]
    x_mm, y_mm = strokes.x_mm, strokes.y_mm
    fit = fit_drags(paths, strokes.ink[chosen][:, rows, columns], x_mm[columns], y_mm[rows], place[chosen])
    there = fit.distance([strokes.paths[k] for k in test], x_mm, y_mm, place[test])
    here = fit.distance(paths, x_mm, y_mm, place[chosen])
    missed = Residual.fit(strokes.commands[chosen], here, captured[chosen], SCALES)
    return chance(there), chance(missed.add(strokes.commands[test], there))


def circles(strokes: Strokes, chosen: NDArray[np.int64], test: NDArray[np.int64]) -> Scores:
    """Discs at the tip all along the commanded path, fitted to the chosen strokes: radius by depth, a shift by depth,
    and how far along the path the radius settles; no leash."""
    rows, columns = (slice(s.start, s.stop, 2) for s in _region(strokes)[1:])
    paths, spread = [strokes.paths[k] for k in chosen], CIRCLE_SPREAD_MM
    x_mm, y_mm = strokes.x_mm[columns], strokes.y_mm[rows]
    fit = fit_drags(paths, strokes.ink[chosen][:, rows, columns], x_mm, y_mm, lag=False, spread_mm=spread)
    here = chance(fit.distance(paths, strokes.x_mm, strokes.y_mm), spread)
    above = max(CIRCLE_ABOVE, key=lambda a: score(strokes, chosen, here, a).csim)
    there = fit.distance([strokes.paths[k] for k in test], strokes.x_mm, strokes.y_mm)
    return score(strokes, test, chance(there, spread), above)


def score(strokes: Strokes, test: NDArray[np.int64], chances: NDArray[np.floating], above: float = INK_ABOVE) -> Scores:
    """Means over the test strokes of the chances of ink, (n, rows, columns)."""
    rows: list[tuple[float, float, float, float]] = []
    for k, seen in zip(test, chances, strict=True):
        truth, ink = strokes.ink[k], seen > above
        union = float(np.count_nonzero(ink | truth))
        padded = np.pad(ink.astype(np.float32), SHIFT_PX)
        overlap = cv2.matchTemplate(padded, truth.astype(np.float32), cv2.TM_CCORR)
        norm = max(1.0, float(np.sqrt(np.count_nonzero(ink) * np.count_nonzero(truth))))
        rows.append(
            (
                np.count_nonzero(ink & truth) / norm,
                np.count_nonzero(ink & truth) / union,
                float(overlap.max()) / norm,
                float(seen[truth].sum() / (np.linalg.norm(seen) * np.sqrt(np.count_nonzero(truth)) + 1e-9)),
            )
        )
    return Scores(*(float(v) for v in np.mean(rows, axis=0)))


def _region(strokes: Strokes) -> tuple[slice, slice, slice]:
    left, right, reach = CROP_MM
    columns = np.flatnonzero((strokes.x_mm > left) & (strokes.x_mm < right))
    rows = np.flatnonzero(np.abs(strokes.y_mm) < reach)
    return slice(None), slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _words(scores: Floats) -> str:
    csim, iou, shifted, gray = scores.mean(axis=0)
    return f"{csim:.3f} / {iou:.3f} (shift {shifted:.3f}, gray {gray:.3f})"


def main(arguments: Sequence[str]) -> None:
    """`python -m bench.realink [--quick | SUBSETS [SIZE...]]`: prints each size as soon as it is measured."""
    quick = "--quick" in arguments
    numbers = [int(word) for word in arguments if word != "--quick"]
    subsets = numbers[0] if numbers else 2 if quick else SUBSETS
    try:
        strokes = load()
    except BenchError as error:
        sys.stderr.write(f"realink: skipped: {error}\n")
        return
    for size in numbers[1:] or (QUICK_SIZES if quick else SIZES):
        results = measure(strokes, size, subsets, 0, QUICK_STEPS if quick else NETWORK_STEPS)
        sys.stdout.write("\n".join([f"# {results[0].conditions}", *(r.to_line() for r in results), ""]))
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
