"""What the arm is doing, by where its tip is and where it goes."""

from __future__ import annotations

import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.faults import Phase, Truth
from brushloop.drivers.sim.world import World

TABLE = Table()
OVER, NEAR, ON, IN = ((100.0, 80.0, h) for h in (60.0, 8.0, 0.03, -15.0))
WELL, INK = (*TABLE.well_mm, 60.0), (*TABLE.well_mm, 2.0)
HOME = None
"""Where the tip rests when the rig starts."""


def base(spot: tuple[float, float, float] | None) -> Pose:
    """The pose of a place in the paper frame, in mm above the sheet; the table's yaw is 90 deg."""
    if spot is HOME:
        return brush_pose(*SimConfig().home_mm)
    x, y, above = spot
    return brush_pose(TABLE.origin_mm[0] - y, TABLE.origin_mm[1] + x, TABLE.paper_z_mm + above)


@pytest.mark.parametrize(
    ("here", "to", "phase"),
    [
        (HOME, HOME, Phase.PARKED),
        (OVER, OVER, Phase.RESTING),
        (HOME, OVER, Phase.TRAVELLING),
        (OVER, NEAR, Phase.TRAVELLING),  # the fast approach ends above the paper
        (NEAR, ON, Phase.DESCENDING),
        (ON, IN, Phase.DESCENDING),
        (ON, ON, Phase.PRESSED),
        (IN, IN, Phase.PRESSED),
        (IN, NEAR, Phase.LIFTING),
        (NEAR, OVER, Phase.LIFTING),
        (OVER, HOME, Phase.TRAVELLING),
        (HOME, WELL, Phase.TRAVELLING),
        (WELL, INK, Phase.DIPPING),
        (INK, INK, Phase.DIPPING),
        (INK, WELL, Phase.DIPPING),
        (WELL, HOME, Phase.TRAVELLING),
    ],
)
def test_each_piece_of_a_press_and_of_a_dip_has_its_phase(
    here: tuple[float, float, float] | None, to: tuple[float, float, float] | None, phase: Phase
):
    world = World(SimConfig())
    world.clock = clock = StoppedClock()  # type: ignore[assignment]
    world.motion.add(base(here), 200.0, 1000.0, clock.s)
    clock.s = 100.0
    world.motion.add(base(to), 200.0, 1000.0, clock.s)
    assert Truth(world).phase() is phase


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


@pytest.mark.parametrize(
    ("above_mm", "phase"), [(3.0, Phase.RESTING), (0.05, Phase.PRESSED), (-2.0, Phase.PRESSED), (60.0, Phase.RESTING)]
)
@pytest.mark.parametrize("corner_mm", [(10.0, 10.0), (230.0, 10.0), (10.0, 160.0)])
def test_on_a_sloping_sheet_heights_count_from_the_paper_under_the_tip(
    corner_mm: tuple[float, float], above_mm: float, phase: Phase
):
    table = Table(yaw_deg=0.0, slope_deg=(1.0, -1.0))
    (x, y), (left, front) = corner_mm, table.origin_mm
    world = World(SimConfig(table=table))
    world.clock = clock = StoppedClock()  # type: ignore[assignment]
    world.motion.add(brush_pose(left + x, front + y, table.surface_z_mm(x, y) + above_mm), 100.0, 1000.0, clock.s)
    clock.s = 60.0
    assert Truth(world).phase() is phase
