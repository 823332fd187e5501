"""Constants of a twin in scales from their defaults."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.drivers.sim.brush.spec import ALLOWED, BrushSpec
from brushloop.twin.constants import SHAPE, SPREAD, Constant, Offset, brush_at, offset_at, search_bounds, with_values


@given(st.sampled_from([*SHAPE, *SPREAD]), st.floats(-8.0, 8.0))
def test_a_value_is_one_that_the_brush_allows_and_lies_where_it_says(one: Constant, scales: float) -> None:
    low, high = ALLOWED[one.name]
    value = one.value(scales)
    assert low <= value <= high
    if low < value < high:
        assert one.scales(value) == pytest.approx(scales, abs=1e-6)


def test_the_middle_of_the_search_is_the_default_brush_of_the_captured_size() -> None:
    base = BrushSpec(radius_mm=5.0, length_mm=40.0, seed=3)
    middle = np.zeros(len(SHAPE) + 3)
    low, high = search_bounds()
    assert brush_at(middle, base) == base
    assert offset_at(middle) == Offset(0.0, 0.0, 0.0)
    assert np.all(low < middle)
    assert np.all(middle <= high)


def test_the_spread_is_set_without_touching_the_shape() -> None:
    found = with_values(BrushSpec(friction=0.3), SPREAD, [1.0] + [0.0] * (len(SPREAD) - 1))
    assert found.friction == 0.3
    assert found.spread_wander == pytest.approx(BrushSpec().spread_wander * np.exp(0.7))
