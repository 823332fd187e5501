"""Zero touch by force: hinges and first ink, many touches of the loopback brush, and what is refused. The plane of the
paper: fitted through touches, and the poses above and below it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import ForceTouchConfig, PaperConfig
from brushloop.collect.rig.paper import PaperPlane, fit_plane
from brushloop.collect.touch import force
from brushloop.collect.touch.camera import first_ink
from brushloop.collect.touch.force import Contact, Reading, find_contact, touch_by_force
from brushloop.collect.touch.heights import Reach
from brushloop.drivers.geometry import distance, lean
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import push_on

Push = Callable[[float, float], float]
HINGE_NOISE_N = 0.002


def contact_of(z_mm: np.ndarray, force_n: np.ndarray) -> Contact:
    return find_contact([Reading(*rest, 50, HINGE_NOISE_N) for rest in zip(z_mm, force_n, strict=True)])


@given(
    contact_mm=st.floats(119.8, 120.3),
    stiffness=st.floats(1e-3, 1.0),
    offset_n=st.floats(-0.5, 0.5),
    step_mm=st.sampled_from([0.05, 0.07, 0.1]),
)
def test_a_clean_hinge_is_found_exactly(contact_mm: float, stiffness: float, offset_n: float, step_mm: float) -> None:
    z_mm = np.arange(120.6, 119.5, -step_mm)
    found = contact_of(z_mm, offset_n + stiffness * np.maximum(0.0, contact_mm - z_mm))
    assert found.z_mm == pytest.approx(contact_mm, abs=1e-5)
    assert found.spring.n_mm == pytest.approx(stiffness, rel=1e-4)


def test_an_offset_of_each_descent_is_no_force() -> None:
    z_mm = np.array([120.3, 120.2, 119.9, 119.7, 120.1, 119.9, 119.8])
    run = np.array([0, 0, 0, 0, 1, 1, 1])
    force_n = 0.003 * np.maximum(0.0, 120.0 - z_mm) + 0.01 * run  # drifts by more than the whole push
    rests = zip(z_mm, force_n, run, strict=True)
    readings = [Reading(z, push_n, 100, HINGE_NOISE_N, descent) for z, push_n, descent in rests]
    assert find_contact(readings).z_mm == pytest.approx(120.0, abs=1e-6)


@pytest.mark.parametrize(
    "force_n", [np.linspace(1.0, 0.0, 8), np.zeros(8)], ids=["falls on the way down", "does not change"]
)
def test_no_rise_is_no_contact(force_n: np.ndarray) -> None:
    with pytest.raises(StepError, match="no contact"):
        contact_of(np.arange(120.7, 119.95, -0.1)[:8], force_n)


@pytest.mark.parametrize(
    ("inked", "why"),
    [([True, True, True], "higher than expected"), ([False, True, False], "is the brush dry")],
)
def test_a_row_that_does_not_tell_is_refused(inked: list[bool], why: str) -> None:
    with pytest.raises(StepError, match=why):
        first_ink(np.array(inked))


NOISE_N = SimConfig().force_noise_n
REACH = Reach(122.0, 120.0, 118.0)


@dataclass
class Felt:
    """Rests over the loopback brush's own reaction, with the noise of the rig's sensor."""

    reaction: Push
    touch_z_mm: float
    rng: np.random.Generator
    lean_deg: float = 0.0
    deepest_mm: float = -math.inf

    async def rest(self, z_mm: float, samples: int) -> Reading:
        depth_mm = (self.touch_z_mm - z_mm) * math.cos(math.radians(self.lean_deg))
        self.deepest_mm = max(self.deepest_mm, depth_mm)
        drawn = self.rng.normal(self.reaction(depth_mm, self.lean_deg), NOISE_N, samples)
        return Reading(z_mm, float(drawn.mean()), samples, float(drawn.std(ddof=1)))


@pytest.fixture(scope="module")
def reaction() -> Push:
    return push_on(SimConfig().brush)


async def touched(reaction: Push, seed: int, config: ForceTouchConfig) -> tuple[float, Contact, Felt]:
    """(error in mm, contact, probe) of one touch at a random height, on a sheet that leans by up to 1 deg."""
    rng = np.random.default_rng(seed)
    truth = 120.0 + rng.uniform(-1.0, 1.0)
    probe = Felt(reaction, truth, rng, rng.uniform(0.0, 1.0))
    contact = await touch_by_force(probe.rest, REACH, config)
    return contact.z_mm - truth, contact, probe


async def test_touches_lie_within_a_tenth_of_the_truth_at_3_sigma(reaction: Push) -> None:
    found = [await touched(reaction, seed, ForceTouchConfig()) for seed in range(80)]
    errors = np.array([error for error, _, _ in found])
    assert abs(errors.mean()) + 3.0 * errors.std(ddof=1) < 0.1
    assert abs(errors.mean()) < 0.01
    # what a touch says of its own error is true
    assert errors.std(ddof=1) == pytest.approx(float(np.mean([c.sigma_mm for _, c, _ in found])), rel=0.2)
    assert max(probe.deepest_mm for _, _, probe in found) < 2.0, "a touch is no press"


@pytest.mark.parametrize("moved_mm", [-0.7, -0.3, 0.3, 0.7])
async def test_a_sheet_that_moved_since_the_last_touch_is_found(reaction: Push, moved_mm: float) -> None:
    rng = np.random.default_rng(3)
    first = await touch_by_force(Felt(reaction, 120.0, rng).rest, REACH, ForceTouchConfig())
    moved = Felt(reaction, 120.0 + moved_mm, rng)
    contact = await touch_by_force(moved.rest, REACH, ForceTouchConfig(), first.spring.next(), first.z_mm)
    assert contact.z_mm == pytest.approx(120.0 + moved_mm, abs=0.13)


@pytest.mark.parametrize(
    ("paper_z_mm", "samples", "said"),
    [
        (117.0, force.MOST_SAMPLES, r"no contact was found down to 118\.00 mm"),
        (124.0, force.MOST_SAMPLES, "touches already"),
        (
            120.0,
            2000,
            r"brush's stiffness is known only to within 1\d%, 10% is needed\. .* choose another touch\.method",
        ),
    ],
)
async def test_a_touch_that_finds_nothing_begins_too_low_or_stays_unsure_is_refused(
    reaction: Push, monkeypatch: pytest.MonkeyPatch, paper_z_mm: float, samples: int, said: str
) -> None:
    monkeypatch.setattr(force, "MOST_SAMPLES", samples)
    with pytest.raises(StepError, match=said):
        await touch_by_force(Felt(reaction, paper_z_mm, np.random.default_rng(1)).rest, REACH, ForceTouchConfig())


FEW_SAMPLES = ForceTouchConfig(sigma_mm=0.3, fast_samples=20, medium_samples=40, slow_samples=100)


@pytest.mark.parametrize("seed", [1, 11, 12])
async def test_rests_that_are_noisy_still_are_repeated_and_do_not_end_the_touch(reaction: Push, seed: int) -> None:
    assert abs((await touched(reaction, seed, FEW_SAMPLES))[0]) < 3.0 * FEW_SAMPLES.sigma_mm


async def test_a_contact_in_the_air_is_not_believed(reaction: Push) -> None:
    config, probe = ForceTouchConfig(), Felt(reaction, 120.0, np.random.default_rng(1))

    async def rest(z_mm: float, samples: int) -> Reading:
        if samples not in (config.fast_samples, config.medium_samples):
            probe.touch_z_mm = 122.5  # only the slow descents feel a push in the air
        return await probe.rest(z_mm, samples)

    with pytest.raises(StepError, match="the brush was still in the air"):
        await touch_by_force(rest, REACH, config)


# The plane of the paper

CORNERS = [(5.0, 5.0), (235.0, 5.0), (5.0, 165.0), (235.0, 165.0)]
slopes = st.floats(-0.017, 0.017)  # 1 deg


def paper(yaw_deg: float = 90.0) -> PaperConfig:
    return PaperConfig(origin_mm=(460.0, -110.0), yaw_deg=yaw_deg, touch_z_mm=120.0, size_mm=(244.0, 172.0))


def touches(plane: PaperPlane, at: list[tuple[float, float]]) -> list[tuple[float, float, float]]:
    return [(x, y, plane.touch_z_mm(x, y)) for x, y in at]


def test_one_or_two_points_give_a_level_sheet_and_a_fourth_leaves_residuals_that_show_a_bump() -> None:
    assert fit_plane([(5.0, 5.0, 120.1)]) == (PaperPlane(120.1), (0.0,))
    plane, residuals_mm = fit_plane([(5.0, 5.0, 120.0), (205.0, 5.0, 120.4)])
    assert plane == PaperPlane(120.2)
    assert residuals_mm == pytest.approx((-0.2, 0.2))
    *points, (x, y, z) = touches(PaperPlane(120.0, 0.01, -0.005), CORNERS)
    assert fit_plane([*points, (x, y, z + 0.4)])[1] == pytest.approx((0.1, -0.1, -0.1, 0.1))


STEEP = touches(PaperPlane(120.0, math.tan(math.radians(5.0))), CORNERS[:3])


@pytest.mark.parametrize(
    ("points_mm", "why"),
    [([(5.0, 5.0, 120.0), (120.0, 10.0, 120.0), (235.0, 5.0, 120.0)], "of a line"), (STEEP, r"lean by 5\.0 deg")],
)
def test_points_on_a_line_or_on_no_sheet_give_no_plane(points_mm: list[tuple[float, float, float]], why: str) -> None:
    with pytest.raises(StepError, match=why):
        fit_plane(points_mm)


@given(slope_x=slopes, slope_y=slopes, above_mm=st.floats(-20.0, 20.0), yaw_deg=st.floats(-180.0, 180.0))
def test_a_pose_lies_its_distance_along_the_normal_and_leans_with_the_sheet(
    slope_x: float, slope_y: float, above_mm: float, yaw_deg: float
) -> None:
    plane, at = PaperPlane(120.0, slope_x, slope_y), paper(yaw_deg)
    touch, pose = plane.pose(at, 80.0, 60.0, 0.0), plane.pose(at, 80.0, 60.0, above_mm)
    moved_mm, turned_deg = distance(touch, pose)
    assert moved_mm == pytest.approx(abs(above_mm), abs=1e-9)
    assert turned_deg == pytest.approx(0.0, abs=1e-5)
    assert plane.above_mm(at, pose) == pytest.approx(above_mm, abs=1e-9)
    # upright on the paper is a lean by the paper's slope in the base frame
    assert lean(pose)[0] == pytest.approx(plane.slope_deg, abs=1e-5)


@given(slope_x=slopes, slope_y=slopes, tilt_deg=st.floats(0.0, 15.0), turn_deg=st.floats(-180.0, 180.0))
def test_tilt_is_counted_from_the_normal(slope_x: float, slope_y: float, tilt_deg: float, turn_deg: float) -> None:
    plane = PaperPlane(120.0, slope_x, slope_y)
    upright = plane.pose(paper(), 80.0, 60.0, -5.0, turn_deg=turn_deg)
    tilted = plane.pose(paper(), 80.0, 60.0, -5.0, tilt_deg=tilt_deg, turn_deg=turn_deg)
    assert distance(upright, tilted)[1] == pytest.approx(tilt_deg, abs=1e-5)
    assert upright.position_mm == tilted.position_mm
