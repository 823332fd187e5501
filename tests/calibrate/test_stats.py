"""Intervals and tests behave as they must on cases that can be computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.stats import holm, paired, summarise


def strata(*sizes: int) -> np.ndarray:
    return np.repeat(np.arange(len(sizes)), sizes)


def test_a_summary_is_max_min_average_and_median_without_what_is_missing() -> None:
    found = summarise(np.array([1.0, np.nan, 3.0, 8.0]), strata(4))
    assert found is not None
    assert (found.n, found.max, found.min, found.avg, found.median) == (3, 8.0, 1.0, 4.0, 3.0)
    assert summarise(np.array([np.nan]), strata(1)) is None


def test_two_presses_of_one_cell_give_no_interval() -> None:
    found = summarise(np.array([90.0, 91.0]), strata(2))
    assert found is not None
    assert found.avg_interval is None


def test_the_interval_is_that_of_the_mean_for_many_presses_of_a_cell() -> None:
    values = np.random.default_rng(1).normal(90.0, 2.0, 400)
    found = summarise(values, strata(400))
    assert found is not None
    assert found.avg_interval is not None
    low, high = found.avg_interval
    assert (high - low) / 2 == pytest.approx(1.96 * values.std() / 20.0, rel=0.1)
    assert low < found.avg < high


def test_with_few_presses_of_each_cell_whole_cells_are_drawn() -> None:
    cells = np.repeat([50.0, 60.0, 70.0, 80.0], 2)  # both presses of a cell alike: as the ceiling of two presses is
    found = summarise(cells, strata(2, 2, 2, 2))
    assert found is not None
    assert found.avg_interval is not None
    assert found.median_interval is not None
    assert found.avg_interval[0] < 57.0
    assert found.avg_interval[1] > 73.0
    assert found.median == 65.0
    assert found.median_interval[0] >= 50.0


def test_a_paired_test_counts_every_flip_of_few_differences() -> None:
    found = paired(np.zeros(5), np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.arange(5))
    assert found is not None
    assert found.mean == 3.0
    assert found.p == pytest.approx(2 / 32)


def test_presses_of_one_cell_are_flipped_and_drawn_together() -> None:
    rng = np.random.default_rng(5)
    cells = strata(*[10] * 4)
    before = rng.normal(90.0, 3.0, 40)
    # The change has one sign in every cell by chance; ten presses of a cell are no further evidence of it.
    found = paired(before, before + np.array([0.2, 1.8, 0.4, 2.4])[cells] + rng.normal(0.0, 0.1, 40), cells)
    assert found is not None
    assert (found.n, found.groups) == (40, 4)
    assert found.p == pytest.approx(2 / 16)
    assert found.interval is not None
    assert found.interval[1] - found.interval[0] > 1.0


def test_a_shift_within_noise_is_no_difference_and_a_clear_one_is() -> None:
    rng = np.random.default_rng(4)
    before, alone = rng.normal(90.0, 3.0, 100), np.arange(100)
    noise = paired(before, before + rng.normal(0.0, 1.0, 100), alone)
    shift = paired(before, before + rng.normal(1.0, 1.0, 100), alone)
    assert noise is not None
    assert shift is not None
    assert noise.p > 0.05
    assert shift.p < 0.001
    assert shift.interval is not None
    assert shift.interval[0] > 0.5
    same = paired(before, before.copy(), alone)
    assert same is not None
    assert same.p == 1.0
    assert paired(np.array([np.nan]), np.array([1.0]), np.array([0])) is None


def test_many_tests_are_corrected_together() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([]) == []
