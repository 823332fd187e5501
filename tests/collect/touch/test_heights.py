"""The touches of one point compared with each other."""

from __future__ import annotations

import pytest

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.touch.heights import Touch, at_one_point


@pytest.mark.parametrize(
    ("sigma_mm", "second_mm", "repeats"),
    [(None, 0.14, True), (None, 0.16, False), (0.02, 0.16, False), (0.04, 0.19, True), (0.04, 0.21, False)],
)
def test_touches_may_span_the_limit_or_five_of_their_standard_errors(
    sigma_mm: float | None, second_mm: float, repeats: bool
) -> None:
    touches = [Touch(5.0, 5.0, 120.0, sigma_mm), Touch(5.0, 5.0, 120.0 + second_mm, sigma_mm)]
    if repeats:
        assert at_one_point(touches, TouchConfig(repeatability_mm=0.15)).span_mm == pytest.approx(second_mm)
    else:
        with pytest.raises(StepError, match="does not repeat"):
            at_one_point(touches, TouchConfig(repeatability_mm=0.15))
