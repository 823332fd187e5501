"""Bristle lag on real dragged strokes; skipped where the data set is not beside the checkout."""

from __future__ import annotations

import numpy as np
import pytest

from bench.realink import circles, predict, score, split
from bench.realink_strokes import BIG, DATA, PX_PER_MM, load
from brushloop.calibrate.drags.captures import commanded_path
from brushloop.calibrate.drags.fit import captured_distance

real = pytest.mark.skipif(not (DATA / BIG).is_dir(), reason="the folder of real strokes is not here")


def test_the_commanded_path_is_the_curve_of_its_four_control_points() -> None:
    path = commanded_path(30.0, 12.0, 0.8 * 18.0, 0.2 * 18.0)
    assert path[0].tolist() == pytest.approx([0.0, 0.0, 0.2 * 18.0, 0.0])
    assert path[-1].tolist() == pytest.approx([30.0, 0.0, 0.2 * 18.0, 0.0])
    assert path[:, 1].max() == pytest.approx(0.75 * 12.0, abs=0.02)
    assert path[:, 2].max() == pytest.approx(0.8 * 18.0)


@real
@pytest.mark.soak
def test_lag_beats_circle_stamps_on_strokes_that_were_never_fitted() -> None:
    strokes = load()
    assert len(strokes.paths) == 187
    train, test = split(187)
    chosen = np.random.default_rng(5).permutation(train)[:20]
    captured = captured_distance(strokes.ink, 1.0 / PX_PER_MM)
    _, corrected, above = predict(strokes, captured, chosen, test)
    ours = score(strokes, test, corrected, above)
    stamps = circles(strokes, chosen, test)
    assert ours.csim > 0.82
    assert ours.iou > 0.70
    assert ours.csim > stamps.csim + 0.08


def test_the_test_strokes_are_fixed_and_never_trained_on() -> None:
    train, test = split(187)
    assert len(test) == 40
    assert not set(train.tolist()) & set(test.tolist())
    assert split(187)[1].tolist() == test.tolist()
