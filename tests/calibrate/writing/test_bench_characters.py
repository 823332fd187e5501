"""`bench characters`: ink laid straight on a cell, and what a result says."""

from __future__ import annotations

import numpy as np
import pytest

from bench.characters import SIDE_MM, Writer, _result, run
from brushloop.calibrate.writing.compare import as_ink
from brushloop.calibrate.writing.plan_files import figure_record
from brushloop.calibrate.writing.scores import Character
from brushloop.drivers.sim.brush.brush import BrushSpec
from brushloop.model.characters.ink import swept
from brushloop.model.characters.plan import Path as Way


def test_a_stroke_lies_where_it_was_drawn_and_is_cut_by_the_cell() -> None:
    writer = Writer(BrushSpec(seed=1), seed=1)
    across = np.column_stack(
        (np.linspace(20, 50, 16), np.full(16, 56.0), np.full(16, 6.0), np.full(16, 5.0), np.zeros(16))
    )
    ink = writer.ink([across])
    rows, columns = np.nonzero(ink > 0.5)
    assert rows.mean() * SIDE_MM / 128 == pytest.approx(SIDE_MM - 56.0, abs=1.0)
    assert 25 < columns.mean() < 64  # behind the tip, as a dragged brush is
    outside = across.copy()
    outside[:, 0] -= 24.0
    assert (writer.ink([outside]) > 0.5).any()


def test_a_result_lists_rounds_and_single_writings() -> None:
    wanted = swept([Way(np.array([[20.0, 35.0], [50.0, 35.0]]), np.full(2, 3.0))], SIDE_MM)
    figure = figure_record("一", "test", [], [], wanted=wanted, simulated=wanted)
    thin = wanted.copy()
    thin[:60] = 0.0
    one = Character("一", "test", as_ink(wanted), as_ink(wanted), {"r01": as_ink(wanted), "r02": as_ink(thin)})
    result = _result("test", figure, one, [{"一": 80.0}], 1)
    assert 80.0 < result.value < 100.0
    assert "rounds 80.0;" in result.conditions
    assert "first writing 100.0" in result.conditions


@pytest.mark.parametrize("n", [0, 7])
def test_there_are_six_brushes(n: int) -> None:
    with pytest.raises(ValueError, match="1 to 6 brushes"):
        run(n=n)
