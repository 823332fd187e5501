"""Hinges and first ink: arrays in, a height out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.collect.errors import StepError
from brushloop.collect.touch.camera import first_ink
from brushloop.collect.touch.force import find_contact

NOISE_N = 0.002


def hinge(z_mm: np.ndarray, contact_mm: float, stiffness: float, offset_n: float = 0.0) -> np.ndarray:
    return offset_n + stiffness * np.maximum(0.0, contact_mm - z_mm)


@given(
    contact_mm=st.floats(119.8, 120.3),
    stiffness=st.floats(1e-3, 1.0),
    offset_n=st.floats(-0.5, 0.5),
    step_mm=st.sampled_from([0.05, 0.07, 0.1]),
)
def test_a_clean_hinge_is_found_exactly(contact_mm: float, stiffness: float, offset_n: float, step_mm: float) -> None:
    z_mm = np.arange(120.6, 119.5, -step_mm)
    found = find_contact(z_mm, hinge(z_mm, contact_mm, stiffness, offset_n), np.full(z_mm.size, 50), NOISE_N)
    assert found.z_mm == pytest.approx(contact_mm, abs=1e-5)
    assert found.spring.n_mm == pytest.approx(stiffness, rel=1e-4)
    assert found.samples == 50 * z_mm.size


def test_an_offset_of_each_descent_is_no_force() -> None:
    z_mm = np.array([120.3, 120.2, 119.9, 119.7, 120.1, 119.9, 119.8])
    run = np.array([0, 0, 0, 0, 1, 1, 1])
    force_n = hinge(z_mm, 120.0, 0.003) + 0.01 * run  # drifts by more than the whole push
    found = find_contact(z_mm, force_n, np.full(7, 100), NOISE_N, run)
    assert found.z_mm == pytest.approx(120.0, abs=1e-6)
    together = find_contact(z_mm, force_n, np.full(7, 100), NOISE_N)
    assert abs(together.z_mm - 120.0) > 0.05


def test_the_standard_error_is_what_repeats_scatter_by() -> None:
    rng = np.random.default_rng(3)
    z_mm, samples = np.linspace(120.4, 119.6, 17), np.full(17, 400)
    found = [
        find_contact(z_mm, hinge(z_mm, 120.013, 0.003) + rng.normal(0.0, NOISE_N, 17) / 20.0, samples, NOISE_N)
        for _ in range(300)
    ]
    errors = np.array([f.z_mm - 120.013 for f in found])
    assert errors.std() == pytest.approx(float(np.mean([f.sigma_mm for f in found])), rel=0.15)
    assert abs(errors.mean()) < 3.0 * errors.std() / np.sqrt(300)


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_more_samples_weigh_more(seed: int) -> None:
    rng = np.random.default_rng(seed)
    z_mm = np.repeat(np.arange(120.4, 119.5, -0.1), 2)
    samples = np.tile([10_000, 1], z_mm.size // 2)
    force_n = hinge(z_mm, 120.0, 0.003) + np.where(samples == 1, rng.normal(0.0, 0.01, z_mm.size), 0.0)
    assert find_contact(z_mm, force_n, samples, NOISE_N).z_mm == pytest.approx(120.0, abs=0.01)


@pytest.mark.parametrize(
    "force_n", [np.linspace(1.0, 0.0, 8), np.zeros(8)], ids=["falls on the way down", "does not change"]
)
def test_no_rise_is_no_contact(force_n: np.ndarray) -> None:
    with pytest.raises(StepError, match="no contact"):
        find_contact(np.arange(120.7, 119.95, -0.1)[:8], force_n, np.full(8, 10), NOISE_N)


def test_two_heights_are_too_few() -> None:
    with pytest.raises(StepError, match="3 are needed"):
        find_contact(np.array([120.0, 119.0]), np.array([0.0, 1.0]), np.array([9, 9]), NOISE_N)


def test_first_ink_is_between_the_last_clean_spot_and_the_first_inked_one() -> None:
    edge = first_ink(np.array([0.01, -0.02, 0.9, 1.1]), 0.25)
    assert (edge.clean, edge.inked) == (1, 2)


@pytest.mark.parametrize(
    ("ink", "why"),
    [
        ([0.0, 0.1, 0.0], "nothing was touched"),
        ([0.9, 1.0, 1.1], "higher than expected"),
        ([0.0, 0.9, 0.1], "is the brush dry"),
    ],
)
def test_a_row_that_does_not_tell_is_refused(ink: list[float], why: str) -> None:
    with pytest.raises(StepError, match=why):
        first_ink(np.array(ink), 0.25)
