"""How far the ceiling is from the score of a perfect model, and how often its interval holds it.

Brushes: the frozen five of the loopback rig, and two of an independent simulation of hairs (`bristle_repeats`); 28
presses of each cell. A session takes a few of one half of a cell's presses. The truth comes from the other half, by
another way than the estimate: the best image of its presses, scored on them. Scored on the presses that it was made of,
an image does too well by about as much as one that was made without them does too badly, so the truth is the mean of
both scores.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bench.brushfit_brushes import FROZEN
from bench.brushfit_presses import BRISTLES, CELLS, simulated
from bench.harness import Result
from brushloop.calibrate.compare.ceiling import average, ceiling_values, pair_means
from brushloop.calibrate.compare.compiled import compare
from brushloop.calibrate.compare.field import SIZE_PX

SESSIONS = 40
PRESSES = 28
EVERY = 2
"""Of the cells of a frozen brush every second one is pressed."""
HAIRS = ("brush_1", "brush_4")
GOALS = {10: 0.3, 5: 0.5, 3: 1.0, 2: 1.0}
"""Points by which the ceiling may be off on average, by presses of a cell."""
COVERED = 0.9
"""Share of the sessions whose interval is to hold the truth."""
NORMAL_95 = 1.96
MEASURES = ("csim", "ssim")
ROUNDS = 3
Pixels = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Session:
    """What one session says about a brush, percent; each (sizes, measures) but the truth, (measures,)."""

    truth: Floats
    truth_error: Floats
    """Standard error of the truth, (measures,)."""
    ceiling: Floats
    ends: Floats
    """Of the interval, (sizes, measures, 2)."""
    pairs: Floats
    """Mean score of two presses of a cell."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Mean error of the ceiling over `n` sessions (default 40) of each brush, by presses of a cell.

    ratio = the goal over the error. The interval is widened by the error of the truth before its coverage is counted.
    SSIM has the same goals, but only CSIM decides anything.
    """
    sessions = SESSIONS if n is None else n
    if sessions < 1:
        raise ValueError(f"n = {n}: at least one session is needed")
    return [one for name, cells in brushes() for one in _results(name, cells, sessions, seed)]


def brushes() -> Iterator[tuple[str, list[Pixels]]]:
    """Name and cells of each brush, (28, 128, 128) each; those of hairs only where their data are at hand."""
    for number, spec in enumerate(FROZEN, 1):
        ink = simulated(spec, f"frozen-{number}", PRESSES, CELLS[::EVERY]).ink > 0.5
        yield f"frozen-{number}", [_on_field(cell) for cell in ink]
    for name in HAIRS:
        path = BRISTLES / "bristle_repeats" / f"{name}.npz"
        if not path.exists():
            sys.stderr.write(f"ceiling: {path.name} is not beside this checkout: measured on the loopback rig only\n")
            return
        with np.load(path) as file:
            masks = np.unpackbits(file["masks"], axis=-1)[..., : int(file["shape"][-1])] > 0
        yield f"hairs-{name}", [_on_field(cell) for cell in masks]


def _on_field(cell: NDArray[np.bool_]) -> Pixels:
    """The presses of a cell in the middle of the field, ink as 255."""
    rows, columns = (np.flatnonzero(cell.any(axis=(0, 3 - axis))) for axis in (1, 2))
    mark = cell[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    top, left = ((SIZE_PX - side) // 2 for side in mark.shape[1:])
    out = np.zeros((len(cell), SIZE_PX, SIZE_PX), np.uint8)
    out[:, top : top + mark.shape[1], left : left + mark.shape[2]] = np.where(mark, 255, 0)
    return out


def session(cells: Sequence[Pixels], seed: Sequence[int]) -> Session:
    """One session with as many presses of each cell as `GOALS` names, and the truth about them."""
    rng = np.random.default_rng(seed)
    truths: list[Floats] = []
    taken: list[Pixels] = []
    for cell in cells:
        order = rng.permutation(len(cell))
        half = len(cell) // 2
        truths.append(best_scores(cell[order[:half]]))
        taken.append(cell[order[half:]])
    error = np.sqrt(np.sum([one.var(axis=0, ddof=1) / len(one) for one in truths], axis=0)) / len(cells)
    shape = (len(GOALS), len(MEASURES))
    ceiling, pairs, ends = np.empty(shape), np.empty(shape), np.empty((*shape, 2))
    for k, size in enumerate(GOALS):
        each = np.concatenate([pair_means(size, partial(_pairs, presses)) for presses in taken])
        number = np.repeat(np.arange(len(cells)), size)
        pairs[k] = 100.0 * each.mean(axis=0)
        for j in range(len(MEASURES)):
            found = average(ceiling_values(100.0 * each[:, j], number), number)
            assert found is not None
            ceiling[k, j], ends[k, j] = found.mean, found.interval or (-np.inf, np.inf)
    return Session(np.mean([one.mean(axis=0) for one in truths], axis=0), error, ceiling, ends, pairs)


def best_scores(presses: Pixels) -> Floats:
    """(n, measures) percent: what the best image of these presses scores on each, free of bias to first order."""
    seen = scores(best_image(presses), presses)
    alone = [scores(best_image(np.delete(presses, k, axis=0)), presses[k : k + 1])[0] for k in range(len(presses))]
    return 50.0 * (seen + np.array(alone))


def best_image(presses: Pixels) -> Pixels:
    """The pixels that so many presses ink that they raise the cosine: more than half of the score itself."""
    chance, attained = (presses > 0).mean(axis=0), 1.0
    for _ in range(ROUNDS):
        image = np.where(chance > 0.5 * attained, 255, 0).astype(np.uint8)
        attained = float(scores(image, presses)[:, 0].mean())
    return np.where(chance > 0.5 * attained, 255, 0).astype(np.uint8)


def scores(image: Pixels, presses: Pixels) -> Floats:
    """(n, measures) CSIM and SSIM of an image with presses, from 0 to 1."""
    out = np.empty((len(presses), len(MEASURES)))
    compare(image, presses, 0, out)
    return out


def _pairs(presses: Pixels, one: int, others: list[int]) -> Floats:
    return scores(presses[one], presses[others])


def _results(name: str, cells: Sequence[Pixels], sessions: int, seed: int) -> Iterator[Result]:
    made = [session(cells, [seed, k]) for k in range(sessions)]
    error = np.array([one.ceiling - one.truth for one in made])
    ends = np.array([one.ends - one.ceiling[..., None] for one in made])
    wider = NORMAL_95 * np.array([one.truth_error for one in made])[:, None, :]
    held = (error <= np.hypot(ends[..., 0], wider)) & (-error <= np.hypot(ends[..., 1], wider))
    for j, measure in enumerate(MEASURES):
        truth = np.mean([one.truth[j] for one in made])
        for k, (size, goal) in enumerate(GOALS.items()):
            pair = np.mean([one.pairs[k, j] for one in made])
            off, share = float(error[:, k, j].mean()), float(held[:, k, j].mean())
            where = (
                f"simulated; {len(cells)} cells, {size} presses each; perfect {truth:.2f} %, another press "
                f"{pair:.2f} %, scatter {error[:, k, j].std():.2f} points"
            )
            bias, covered = f"ceiling.bias.{name}.{measure}.{size}", f"ceiling.covered.{name}.{measure}.{size}"
            peer, ratio = f"goal {goal:g} at most", goal / max(abs(off), 0.01)
            yield Result(bias, off, "points", peer, ratio, sessions, seed, where)
            share_peer = f"{100.0 * COVERED:g}"
            yield Result(covered, 100.0 * share, "%", share_peer, share / COVERED, sessions, seed, where)
