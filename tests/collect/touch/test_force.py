"""Zero touch by force on the loopback brush: 200 touches against the truth, and what is refused."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config_touch import ForceTouchConfig
from brushloop.collect.touch.force import Contact, Reading, touch_by_force
from brushloop.collect.touch.heights import SPAN_SIGMAS, Reach
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import Reaction

NOISE_N = SimConfig().force_noise_n
REACH = Reach(122.0, 120.0, 118.0)


class Felt:
    """`Probe` over the loopback brush's own reaction, with the noise of the rig's sensor."""

    def __init__(
        self, reaction: Reaction, touch_z_mm: float, rng: np.random.Generator, *, lean_deg: float = 0.0
    ) -> None:
        self._reaction = reaction
        self._rng = rng
        self._touch_z_mm = touch_z_mm
        self._lean_deg = lean_deg
        self.drift_n = 0.0
        """Added with every sample that was taken."""
        self.noise_n = NOISE_N
        self.samples = 0
        self.deepest_mm = -math.inf
        self.rests = 0
        self.way_mm = 0.0
        self._z_mm: float | None = None

    async def rest(self, z_mm: float, samples: int) -> Reading:
        depth_mm = (self._touch_z_mm - z_mm) * math.cos(math.radians(self._lean_deg))
        self.deepest_mm = max(self.deepest_mm, depth_mm)
        push_n = self._reaction.push_n(depth_mm, self._lean_deg) + self.drift_n * self.samples
        self.samples += samples
        self.rests += 1
        if self._z_mm is not None:
            self.way_mm += abs(z_mm - self._z_mm) + (2.0 if z_mm > self._z_mm else 0.0)
        self._z_mm = z_mm
        drawn = self._rng.normal(push_n, self.noise_n, samples)
        return Reading(z_mm, float(drawn.mean()), samples, float(drawn.std(ddof=1)))


@pytest.fixture(scope="module")
def reaction() -> Reaction:
    made = Reaction(Brush(BrushSpec()), sensor_to_tip_mm=180.0, hanging_kg=0.12)
    made.prepare()
    return made


async def touched(
    reaction: Reaction, seed: int, config: ForceTouchConfig, **drift: float
) -> tuple[float, Contact, Felt]:
    """(error in mm, contact, probe) of one touch at a random height, on a sheet that leans by up to 1 deg."""
    rng = np.random.default_rng(seed)
    truth = 120.0 + rng.uniform(-1.0, 1.0)
    probe = Felt(reaction, truth, rng, lean_deg=rng.uniform(0.0, 1.0))
    probe.drift_n = drift.get("drift_n", 0.0)
    contact = await touch_by_force(probe, REACH, config)
    return contact.z_mm - truth, contact, probe


async def test_200_touches_lie_within_a_tenth_of_the_truth_at_3_sigma(reaction: Reaction) -> None:
    found = [await touched(reaction, seed, ForceTouchConfig()) for seed in range(200)]
    errors = np.array([error for error, _, _ in found])
    sys.stdout.write(
        f"bias {errors.mean():+.4f} mm, sd {errors.std(ddof=1):.4f} mm, largest error {np.abs(errors).max():.3f} mm, "
        f"{np.mean([probe.samples for _, _, probe in found]):.0f} samples a touch\n"
    )
    assert abs(errors.mean()) + 3.0 * errors.std(ddof=1) < 0.1
    assert abs(errors.mean()) < 0.01
    # what a touch says of its own error is true
    assert errors.std(ddof=1) == pytest.approx(float(np.mean([c.sigma_mm for _, c, _ in found])), rel=0.2)
    assert max(probe.deepest_mm for _, _, probe in found) < 2.0, "a touch is no press"


SENSOR_HZ, TOUCH_MM_S, REST_S = 200.0, 5.0, 0.3
"""Rounds of the sensor, speed of a touch, and what a rest takes beside its samples and its way."""


async def test_three_touches_at_each_of_four_points_take_three_minutes(reaction: Reaction) -> None:
    spans, centres, minutes = list[float](), list[float](), list[float]()
    for seed in range(40):
        rng, spring, found, took_s = np.random.default_rng(seed), None, list[float](), 0.0
        for _ in range(4):
            truth, near_z_mm, touches = 120.0 + rng.uniform(-1.0, 1.0), None, list[float]()
            for _ in range(3):
                probe = Felt(reaction, truth, rng, lean_deg=rng.uniform(0.0, 1.0))
                contact = await touch_by_force(probe, REACH, ForceTouchConfig(), spring, near_z_mm)
                spring, near_z_mm = contact.spring, contact.z_mm
                touches.append(contact.z_mm - truth)
                took_s += probe.samples / SENSOR_HZ + probe.way_mm / TOUCH_MM_S + probe.rests * REST_S
            found.append(float(np.mean(touches)))
            spans.append(max(touches) - min(touches))
        centres.append(float(np.mean(found)))
        minutes.append(took_s / 60.0)
    sys.stdout.write(
        f"{np.mean(minutes):.1f} min (most {max(minutes):.1f}); middle of the plane: bias {np.mean(centres):+.4f} mm, "
        f"sd {np.std(centres):.4f} mm; largest span of three touches {max(spans):.3f} mm\n"
    )
    assert max(minutes) < 4.5
    assert np.mean(minutes) < 3.5
    assert max(abs(centre) for centre in centres) < 0.05
    assert max(spans) < SPAN_SIGMAS * ForceTouchConfig().sigma_mm


async def test_a_touch_that_begins_where_the_last_one_was_is_as_good(reaction: Reaction) -> None:
    rng = np.random.default_rng(7)
    first = await touch_by_force(Felt(reaction, 120.4, rng), REACH, ForceTouchConfig())
    probes = [Felt(reaction, 120.4, rng) for _ in range(40)]
    found = [await touch_by_force(probe, REACH, ForceTouchConfig(), first.spring, first.z_mm) for probe in probes]
    errors = np.array([contact.z_mm for contact in found]) - 120.4
    assert abs(errors.mean()) + 3.0 * errors.std(ddof=1) < 0.15
    assert np.mean([probe.samples for probe in probes]) < 2000


@pytest.mark.parametrize("moved_mm", [-0.7, -0.3, 0.3, 0.7])
async def test_a_sheet_that_moved_since_the_last_touch_is_found(reaction: Reaction, moved_mm: float) -> None:
    rng = np.random.default_rng(3)
    first = await touch_by_force(Felt(reaction, 120.0, rng), REACH, ForceTouchConfig())
    moved = Felt(reaction, 120.0 + moved_mm, rng)
    contact = await touch_by_force(moved, REACH, ForceTouchConfig(), first.spring, first.z_mm)
    assert contact.z_mm == pytest.approx(120.0 + moved_mm, abs=0.13)


async def test_a_slow_drift_of_the_sensor_is_no_force(reaction: Reaction) -> None:
    # a tenth of a mN every 1000 samples: over a touch as much as the brush pushes at half a mm
    errors = [(await touched(reaction, seed, ForceTouchConfig(), drift_n=1e-7))[0] for seed in range(30)]
    assert abs(float(np.mean(errors))) < 0.03


async def test_a_quieter_sensor_needs_fewer_samples(reaction: Reaction) -> None:
    loud, quiet = (Felt(reaction, 120.0, np.random.default_rng(1)) for _ in range(2))
    quiet.noise_n = NOISE_N / 4.0
    await touch_by_force(loud, REACH, ForceTouchConfig())
    contact = await touch_by_force(quiet, REACH, ForceTouchConfig())
    assert quiet.samples < 0.6 * loud.samples
    assert contact.z_mm == pytest.approx(120.0, abs=0.05)


async def test_nothing_is_touched_within_the_travel(reaction: Reaction) -> None:
    probe = Felt(reaction, 117.0, np.random.default_rng(1))
    with pytest.raises(StepError, match=r"nothing was touched down to 118\.00 mm"):
        await touch_by_force(probe, REACH, ForceTouchConfig())
    assert probe.deepest_mm == pytest.approx(-1.0)


async def test_a_brush_that_touches_at_the_start_is_refused(reaction: Reaction) -> None:
    with pytest.raises(StepError, match="touches already"):
        await touch_by_force(Felt(reaction, 124.0, np.random.default_rng(1)), REACH, ForceTouchConfig())


async def test_a_sensor_that_is_too_noisy_says_so(reaction: Reaction) -> None:
    config = ForceTouchConfig(max_samples=2000)
    with pytest.raises(StepError, match="too noisy for this brush"):
        await touch_by_force(Felt(reaction, 120.0, np.random.default_rng(1)), REACH, config)


FEW_SAMPLES = ForceTouchConfig(sigma_mm=0.3, fast_samples=20, medium_samples=40, slow_samples=100)


@pytest.mark.parametrize("seed", range(19))
async def test_rests_that_are_noisy_still_are_repeated_and_do_not_end_the_touch(reaction: Reaction, seed: int) -> None:
    assert abs((await touched(reaction, seed, FEW_SAMPLES))[0]) < 3.0 * FEW_SAMPLES.sigma_mm


async def test_a_contact_in_the_air_is_not_believed(reaction: Reaction) -> None:
    with pytest.raises(StepError, match="where the brush was in the air"):
        await touched(reaction, 19, FEW_SAMPLES)
