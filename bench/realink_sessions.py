"""One session of a small brush predicted from another: real ink, two sessions of different travel.

In each split a quarter of the target session is scored. The fit within the session and the one of the other session
have the same number of training strokes. Further contestants are the other session's brush with
place and width adapted to 5 or 10 strokes of the target session, chosen by their commands among those that are not
scored (`brushloop fit --drags --prior --strokes`). Every setting was chosen on training strokes of the big brush, or by
the fit itself on its own training strokes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.harness import BenchError, Result, machine
from bench.realink_strokes import SMALL_A, SMALL_B, drawn, load
from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.drags.captures import Drawn
from brushloop.calibrate.drags.fit import captured_distance, clipped
from brushloop.calibrate.drags.predict import BETWEEN_SESSIONS, Predictor, learn
from brushloop.calibrate.drags.predicted import correction_helps
from brushloop.calibrate.drags.run import adapt, different

SESSION_SPLITS = 5
STROKES = 90
SCORED = 0.25
ADAPTED = (5, 10)
"""Strokes of the target session that a known brush is adapted to."""
SHORT = {SMALL_A: "a", SMALL_B: "b"}
Floats = NDArray[np.float64]


def measure_sessions(splits: int, seed: int) -> list[Result]:
    """Both directions; empty where the strokes are not beside the checkout. Raises ValueError for splits < 1."""
    if splits < 1:
        raise ValueError(f"splits = {splits}: at least one is needed")
    try:
        strokes = {name: load(name) for name in (SMALL_A, SMALL_B)}
    except BenchError:
        return []
    read = {name: drawn(strokes[name], name) for name in strokes}
    results: list[Result] = []
    for source, target in ((SMALL_A, SMALL_B), (SMALL_B, SMALL_A)):
        found = _compare(read[source], read[target], splits, seed)
        results += _results(found, f"{SHORT[source]}-to-{SHORT[target]}", splits, seed)
    return results


def _compare(source: Drawn, target: Drawn, splits: int, seed: int) -> dict[str, Floats]:
    """(splits, 2) mean CSIM and IoU of every contestant."""
    found: dict[str, list[Floats]] = {}
    for k in range(splits):
        rng = np.random.default_rng([seed, k])
        order, other = rng.permutation(len(target.ink)), np.sort(rng.permutation(len(source.ink))[:STROKES])
        test = np.sort(order[: round(SCORED * len(order))])
        left = np.sort(order[len(test) :])
        truth = target.ink[test] > 0.5
        within = learn(target, np.sort(order[-STROKES:])).predictor
        across = learn(source, other)
        known = replace(across.predictor, share=BETWEEN_SESSIONS)
        seen = {
            "within": within.ink(target, test),
            "circles": across.stamps.ink(target, test),
        }
        seen["zero-shot"], seen["lag, zero-shot"] = known.ink_both_ways(target, test)
        seen["whole correction, zero-shot"] = across.predictor.ink(target, test)
        for count in ADAPTED:
            images = different(target, left, count)
            adapted = replace(known, model=adapt(target, images, known).model)
            helps = correction_helps(*adapted.ink_both_ways(target, images), target.ink[images] > 0.5)
            seen[f"adapted to {count}"] = adapted.ink_both_ways(target, test)[0 if helps else 1]
        found.setdefault("slope of what the lag misses", []).append(_slope(across.predictor, target, test))
        for name, ink in seen.items():
            found.setdefault(name, []).append(binary_scores(ink, truth).mean(axis=0))
    return {name: np.array(each) for name, each in found.items()}


def _slope(known: Predictor, target: Drawn, images: NDArray[np.int64]) -> Floats:
    """What the lag misses in a session, regressed through zero on the correction of the other one; given twice."""
    correction, base = known.correction(target, images), clipped(known.distance(target, images))
    assert correction is not None, "imported strokes have commands, so they have a correction"
    missed = clipped(captured_distance(target.ink[images] > 0.5, target.mm_per_px)) - base
    return np.full(2, float((missed * correction).sum() / (correction**2).sum()))


def _results(found: dict[str, Floats], way: str, splits: int, seed: int) -> Sequence[Result]:
    words = "; ".join(
        f"{name} {each[:, 0].mean():.3f} / {each[:, 1].mean():.3f} (sd {each[:, 0].std():.3f})"
        for name, each in found.items()
    )
    where = f"real ink, small brush, {way}, {STROKES} training strokes, {splits} splits"
    conditions = f"{where}; CSIM / IoU, means: {words}; {machine()}"
    results: list[Result] = []
    for name in ("zero-shot", *(f"adapted to {count}" for count in ADAPTED)):
        label = f"realink.{way}.{name.replace(' ', '-')}"
        for column, what in enumerate(("csim", "iou")):
            ours = float(found[name][:, column].mean())
            ratio = ours / float(found["within"][:, column].mean())
            peer = "a fit within the session"
            results.append(Result(f"{label}.{what}", ours, "of 1", peer, ratio, splits, seed, conditions))
    return results
