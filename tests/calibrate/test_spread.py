"""Points in the order in which each is as far as possible from those before."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.spread import farthest_first


def test_the_corners_of_a_line_come_before_its_middle() -> None:
    places = np.array([[0.0], [1.0], [2.0], [3.0], [4.0]])
    assert farthest_first(places, 0, 5) == [0, 4, 2, 1, 3]
    assert farthest_first(places, 2, 3) == [2, 0, 4]


@pytest.mark.parametrize("count", [0, 3])
def test_more_points_than_there_are_cannot_be_chosen(count: int) -> None:
    with pytest.raises(ValueError, match="allowed 1 to 2"):
        farthest_first(np.zeros((2, 1)), 0, count)
