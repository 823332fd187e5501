"""Intervals, tests and the ceiling behave as they must on cases that can be computed by hand.

The ceiling is the score of a perfect model: here the stray of every press is drawn, so that one can be drawn.
"""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.stats import (
    ceiling_values,
    holm,
    interval_over_groups,
    is_near,
    others_of,
    pair_means,
    paired,
    summarise,
)
from brushloop.model.similarity import binary_scores

CONDITIONS = 6
Y, X = np.mgrid[:60, :120]


def strata(*sizes: int) -> np.ndarray:
    return np.repeat(np.arange(len(sizes)), sizes)


def test_a_summary_is_max_min_average_and_median_without_what_is_missing() -> None:
    found = summarise(np.array([1.0, np.nan, 3.0, 8.0]), strata(4))
    assert found is not None
    assert (found.n, found.max, found.min, found.avg, found.median) == (3, 8.0, 1.0, 4.0, 3.0)
    assert summarise(np.array([np.nan]), strata(1)) is None
    two = summarise(np.array([90.0, 91.0]), strata(2))
    assert two is not None
    assert two.avg_interval is None, "two presses of one condition say nothing of their spread"


def test_the_interval_over_groups_does_not_count_the_presses_of_one() -> None:
    # Three conditions, each of which agrees with itself: ten presses a condition tell no more than three numbers do.
    found = interval_over_groups(np.repeat([0.0, 1.0, 2.0], 10), strata(10, 10, 10))
    assert found is not None
    assert found[0] < 0.4
    assert found[1] > 1.6
    assert interval_over_groups(np.array([0.0, 1.0]), strata(1, 1)) is None


def test_a_paired_test_counts_every_flip_of_whole_conditions() -> None:
    found = paired(np.zeros(5), np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.arange(5))
    assert (found.mean, found.p) == (3.0, pytest.approx(2 / 32))
    rng, conditions = np.random.default_rng(5), strata(*[10] * 4)
    before = rng.normal(90.0, 3.0, 40)
    # The change has one sign in every condition by chance; ten presses of a condition are no further evidence of it.
    found = paired(before, before + np.array([0.2, 1.8, 0.4, 2.4])[conditions] + rng.normal(0.0, 0.1, 40), conditions)
    assert (found.n, found.groups, found.p) == (40, 4, pytest.approx(2 / 16))
    assert found.interval is not None
    assert found.interval[1] - found.interval[0] > 1.0
    assert paired(np.ones(20), np.ones(20), np.arange(20)).p == 1.0


def test_many_tests_are_corrected_together() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def presses(rng: np.random.Generator, condition: int, count: int, stray_px: float = 1.5) -> np.ndarray:
    """Marks of one condition: ellipses whose ends and width stray independently."""
    left, right, half = rng.normal(0.0, stray_px, (3, count, 1, 1))
    long, wide = 40.0 + condition + 0.5 * (right - left), 12.0 + condition + 0.5 * half
    return ((X - 60.0 - 0.5 * (left + right)) / long) ** 2 + ((Y - 30.0) / wide) ** 2 < 1.0


def perfect(condition: int) -> float:
    """What the best image of a condition scores on fresh presses of it."""
    best = presses(np.random.default_rng(0), condition, 1, stray_px=0.0)[0]
    marks = presses(np.random.default_rng(1), condition, 400)
    return 100.0 * float(binary_scores(np.broadcast_to(best, marks.shape), marks)[:, 0].mean())


def session(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Ceiling values, conditions and presses."""
    rng = np.random.default_rng(seed)
    drawn = [presses(rng, condition, count) for condition in range(CONDITIONS)]
    pairs = [
        pair_means(count, lambda k, others, of=one: binary_scores(of[[k] * len(others)], of[others])) for one in drawn
    ]
    number = np.repeat(np.arange(CONDITIONS), count)
    return ceiling_values(100.0 * np.concatenate(pairs)[:, 0], number), number, drawn


@pytest.mark.parametrize(("count", "within"), [(10, 0.3), (3, 0.3), (2, 0.4)])
def test_the_ceiling_is_what_a_perfect_model_scores_however_few_presses_there_are(count: int, within: float) -> None:
    truth = np.mean([perfect(condition) for condition in range(CONDITIONS)])
    found = np.mean([session(seed, count)[0].mean() for seed in range(20)])
    assert found == pytest.approx(truth, abs=within)
    pairs = 100.0 - np.sqrt(2.0) * (100.0 - found)  # both presses of a pair stray
    assert pairs < truth - 0.8


def test_the_interval_of_the_ceiling_holds_the_truth_and_is_no_narrower_for_pairs_that_share_presses() -> None:
    truth = np.mean([perfect(condition) for condition in range(CONDITIONS)])
    held = 0
    for seed in range(40):
        values, number, _ = session(100 + seed, 3)
        found = summarise(values, number)
        assert found is not None
        assert found.avg_interval is not None
        held += found.avg_interval[0] <= truth <= found.avg_interval[1]
    assert held >= 36


def test_the_ceiling_values_of_a_condition_are_its_jackknife() -> None:
    _, _, [marks, *_] = session(3, 6)
    pairs = pair_means(6, lambda k, others: 100.0 * binary_scores(marks[[k] * len(others)], marks[others]))[:, 0]

    def mean_pair(at: list[int]) -> float:
        each = [100.0 * binary_scores(marks[[a]], marks[[b]])[0, 0] for a in at for b in at if a < b]
        return 100.0 - (100.0 - float(np.mean(each))) / np.sqrt(2.0)

    every = list(range(6))
    pseudo = [6 * mean_pair(every) - 5 * mean_pair([a for a in every if a != k]) for k in every]
    assert ceiling_values(pairs, np.zeros(6, np.int64)) == pytest.approx(pseudo)


def test_a_press_alone_in_its_condition_has_no_ceiling() -> None:
    assert np.isnan(pair_means(1, lambda k, others: np.zeros((len(others), 2)))).all()
    values = ceiling_values(np.array([np.nan, 90.0, 90.0]), np.array([0, 1, 1]))
    assert np.isnan(values[0])
    assert values[1:] == pytest.approx(100.0 - 10.0 / np.sqrt(2.0))
    assert others_of(1, 3) == [2, 0]
    assert others_of(25, 28) == [26, 27, 0, 1, 2, 3, 4, 5, 6], "nine others at most, as in the paper"


def test_a_model_is_near_where_the_interval_of_the_difference_says_so() -> None:
    conditions = np.repeat(np.arange(5), 4)
    ceiling = 90.0 + 3.0 * conditions + np.random.default_rng(0).normal(0.0, 1.0, 20)
    # The conditions differ by much more than the model is below the ceiling in each.
    found = summarise(ceiling - (ceiling - 1.0 + 0.1 * conditions), conditions)
    assert found is not None
    assert found.avg == pytest.approx(0.8)
    assert is_near(found.avg, found.avg_interval, points=1.5) is True
    assert is_near(found.avg, found.avg_interval, points=0.9) is None
    assert is_near(found.avg, found.avg_interval, points=0.1) is False
    assert is_near(2.0, None) is False
    assert is_near(1.0, (0.5, 1.53)) is True, "both ends are printed as within the goal"
    assert is_near(1.0, (0.5, 1.56)) is None
