"""Bristle lag on real dragged strokes; skipped where the data set is not beside the checkout."""

from __future__ import annotations

import pytest

from bench import accuracy
from bench.brushes import DATA
from brushloop.calibrate.drags.captures import commanded_path


def test_the_commanded_path_is_the_curve_of_its_four_control_points() -> None:
    path = commanded_path(30.0, 12.0, 0.8 * 18.0, 0.2 * 18.0)
    assert path[0].tolist() == pytest.approx([0.0, 0.0, 0.2 * 18.0, 0.0])
    assert path[-1].tolist() == pytest.approx([30.0, 0.0, 0.2 * 18.0, 0.0])
    assert path[:, 1].max() == pytest.approx(0.75 * 12.0, abs=0.02)
    assert path[:, 2].max() == pytest.approx(0.8 * 18.0)


@pytest.mark.skipif(not (DATA / accuracy.BIG).is_dir(), reason="the folder of real strokes is not here")
@pytest.mark.soak
@pytest.mark.timeout(3000)
def test_lag_beats_circle_stamps_on_strokes_that_were_never_fitted() -> None:
    means = accuracy.drags_within(20, draw=0, seed=5)
    assert means["predicted"]["csim"] > 0.82
    assert means["predicted"]["iou"] > 0.70
    assert means["predicted"]["csim"] > means["circle stamps"]["csim"] + 0.08
