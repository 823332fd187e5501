"""What counts as a list of numbers, and that nothing else gets past it."""

from __future__ import annotations

from typing import Any

import pytest

from brushloop.drivers.arcs.wire import numbers


def test_integers_and_floats_are_numbers() -> None:
    assert numbers([1, 2.5, -3], 3) == [1.0, 2.5, -3.0]


@pytest.mark.parametrize(
    "values",
    [
        *("123456", {"0": 1.0}, None, 7, [1, 2], [1, 2, 3, 4], [1, 2, "3"], [1, 2, None], [1, 2, True], [1, 2, [3]]),
        *([1, 2, float("nan")], [1, 2, float("inf")], [1, 2, 10**400]),
    ],
)
def test_anything_else_is_refused(values: Any) -> None:
    with pytest.raises(ValueError, match="expected 3"):
        numbers(values, 3)
