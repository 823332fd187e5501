"""Zero touch by force on the loopback brush: 200 touches against the truth, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from collect.errors import StepError
from collect.rig.config_touch import ForceTouchConfig
from collect.touch.force import Contact, Reading, touch_by_force
from collect.touch.heights import Reach
from drivers.sim.brush.brush import Brush, BrushSpec
from drivers.sim.brush.contact import Reaction
from drivers.sim.config import SimConfig

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

    async def rest(self, z_mm: float, samples: int) -> Reading:
        depth_mm = (self._touch_z_mm - z_mm) * math.cos(math.radians(self._lean_deg))
        self.deepest_mm = max(self.deepest_mm, depth_mm)
        push_n = self._reaction.push_n(depth_mm, self._lean_deg) + self.drift_n * self.samples
        self.samples += samples
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


async def test_200_touches_lie_within_50_um_of_the_truth_at_3_sigma(reaction: Reaction) -> None:
    found = [await touched(reaction, seed, ForceTouchConfig()) for seed in range(200)]
    errors = np.array([error for error, _, _ in found])
    assert abs(errors.mean()) + 3.0 * errors.std(ddof=1) < 0.05
    assert abs(errors.mean()) < 0.005
    # what a touch says of its own error is true
    assert errors.std(ddof=1) == pytest.approx(float(np.mean([c.sigma_mm for _, c, _ in found])), rel=0.2)
    assert max(probe.deepest_mm for _, _, probe in found) < 2.0, "a touch is no press"


async def test_a_touch_that_begins_where_the_last_one_was_is_as_good(reaction: Reaction) -> None:
    rng, errors = np.random.default_rng(7), list[float]()
    near_z_mm: float | None = None
    for _ in range(40):
        near_z_mm = (await touch_by_force(Felt(reaction, 120.4, rng), REACH, ForceTouchConfig(), near_z_mm)).z_mm
        errors.append(near_z_mm - 120.4)
    assert abs(float(np.mean(errors))) + 3.0 * float(np.std(errors)) < 0.06


async def test_a_slow_drift_of_the_sensor_is_no_force(reaction: Reaction) -> None:
    # a tenth of a mN every 1000 samples: over a touch as much as the brush pushes at half a mm
    errors = [(await touched(reaction, seed, ForceTouchConfig(), drift_n=1e-7))[0] for seed in range(30)]
    assert abs(float(np.mean(errors))) < 0.02


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
    config = ForceTouchConfig(max_samples=8000)
    with pytest.raises(StepError, match="too noisy for this brush"):
        await touch_by_force(Felt(reaction, 120.0, np.random.default_rng(1)), REACH, config)
