"""What the arm is doing, by where its tip is and where it goes."""

from __future__ import annotations

import pytest

from drivers.geometry import brush_pose
from drivers.sim.config import SimConfig, Table
from drivers.sim.faults.phases import Phase, Spot, Truth, phase_of
from drivers.sim.world import World

TABLE = Table()
HOME = Spot(-100.0, 200.0, 140.0)
OVER, NEAR, ON, IN = (Spot(100.0, 80.0, h) for h in (60.0, 8.0, 0.03, -15.0))
WELL = Spot(*TABLE.well_mm, 60.0)
INK = Spot(*TABLE.well_mm, 2.0)


@pytest.mark.parametrize(
    ("here", "to", "phase"),
    [
        (HOME, None, Phase.PARKED),
        (OVER, None, Phase.RESTING),
        (HOME, OVER, Phase.TRAVELLING),
        (OVER, NEAR, Phase.TRAVELLING),  # the fast approach ends above the paper
        (NEAR, ON, Phase.DESCENDING),
        (ON, IN, Phase.DESCENDING),
        (ON, None, Phase.PRESSED),
        (IN, None, Phase.PRESSED),
        (IN, NEAR, Phase.LIFTING),
        (NEAR, OVER, Phase.LIFTING),
        (OVER, HOME, Phase.TRAVELLING),
        (HOME, WELL, Phase.TRAVELLING),
        (WELL, INK, Phase.DIPPING),
        (INK, None, Phase.DIPPING),
        (INK, WELL, Phase.DIPPING),
        (WELL, HOME, Phase.TRAVELLING),
    ],
)
def test_each_piece_of_a_press_and_of_a_dip_has_its_phase(here: Spot, to: Spot | None, phase: Phase):
    assert phase_of(TABLE, HOME, here, to) is phase


class StoppedClock:
    def __init__(self) -> None:
        self.s = 0.0

    def now_s(self) -> float:
        return self.s


def test_the_world_knows_its_phase_from_the_first_moment_of_a_line_to_its_last():
    world = World(SimConfig())
    world.clock = clock = StoppedClock()  # type: ignore[assignment]
    truth = Truth(world)
    assert truth.phase() is Phase.PARKED
    x, y, z = world.config.home_mm
    world.motion.add(brush_pose(x + 100.0, y, z), 100.0, 1000.0, clock.s)
    assert truth.phase() is Phase.TRAVELLING
    clock.s = 0.6
    assert truth.phase() is Phase.TRAVELLING
    clock.s = 2.0
    assert truth.phase() is Phase.RESTING
    assert truth.target() is None
