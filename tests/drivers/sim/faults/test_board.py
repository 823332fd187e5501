"""When a fault begins, what it strikes, and when it is over."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.faults import KINDS, Device, Fault, FaultBoard, Phase, Truth, fault_of
from brushloop.drivers.sim.world import World


@dataclass
class Scripted:
    """A world whose state is set by the test, and a clock."""

    presses: int = 0
    sim_s: float = 0.0
    doing: Phase = Phase.PARKED
    real_s: float = 0.0
    board: FaultBoard = field(init=False)

    def __post_init__(self) -> None:
        self.board = FaultBoard(self, real_s=lambda: self.real_s)

    def now_s(self) -> float:
        return self.sim_s

    def phase(self) -> Phase:
        return self.doing

    def strikes(self, *ops: str) -> list[bool]:
        return [self.board.meet(Device.ROBOT, op) is not None for op in ops]


@pytest.fixture
def world() -> Scripted:
    return Scripted()


def mute(**more: object) -> Fault:
    return Fault.model_validate({"device": "robot", "kind": "mute", **more})


def test_without_conditions_a_fault_strikes_the_next_request_and_is_over(world: Scripted):
    world.board.hang(mute())
    assert world.strikes("a", "b") == [True, False]
    assert [hung.struck for hung in world.board.over] == [1]
    assert not world.board.hanging


def test_a_method_is_named_in_short_or_in_full(world: Scripted):
    world.board.hang(mute(on="moveLine", count=2))
    ops = ("rob1.MotionControl.getExecId", "rob1.MotionControl.moveLine", "rob1.MotionControl.moveLines", "moveLine")
    assert world.strikes(*ops) == [False, True, False, True]


def test_the_nth_is_counted_among_requests_for_which_all_else_holds(world: Scripted):
    world.board.hang(mute(on="x", nth=2, phase="descending", count=2))
    assert world.strikes("x", "x") == [False, False]
    world.doing = Phase.DESCENDING
    assert world.strikes("x", "y", "x") == [False, False, True]
    world.doing = Phase.PARKED  # once begun it goes on
    assert world.strikes("y", "x", "x") == [False, True, False]


def test_time_and_presses_are_conditions_too(world: Scripted):
    world.board.hang(mute(after_s=10.0, press=3))
    world.presses = 3
    assert world.strikes("x") == [False]
    world.sim_s = 10.0
    world.presses = 4
    assert world.strikes("x") == [False]
    world.presses = 3
    assert world.strikes("x") == [True]


def test_for_so_many_seconds_counts_from_when_it_begins(world: Scripted):
    world.board.hang(mute(for_s=2.0))
    world.real_s = 100.0
    assert world.strikes("x", "x") == [True, True]
    world.real_s = 101.9
    assert world.strikes("x") == [True]
    world.real_s = 102.0
    assert world.strikes("x") == [False]
    assert [hung.struck for hung in world.board.over] == [3]


@pytest.mark.parametrize(
    "fault",
    [
        Fault(device=Device.ROBOT, kind="protective-stop", phase=Phase.LIFTING),
        Fault(device=Device.ROBOT, kind="emergency-stop", phase=Phase.LIFTING),
    ],
)
def test_a_stop_begins_by_itself_and_once(world: Scripted, fault: Fault):
    world.board.hang(fault)
    assert world.board.meet(fault.device) is None
    assert world.board.due() == []
    world.doing = Phase.LIFTING
    assert world.board.due() == [fault]
    assert world.board.due() == []


def test_a_fault_of_ink_begins_by_itself_and_strikes_the_requests_that_follow(world: Scripted):
    world.board.hang(Fault(device=Device.INK, kind="garbage", phase=Phase.LIFTING, count=2))
    assert world.board.due() == []
    assert world.board.meet(Device.INK) is None
    world.doing = Phase.LIFTING
    world.board.due()
    world.doing = Phase.PARKED
    strikes = [world.board.meet(Device.INK) is not None for _ in range(3)]
    assert strikes == [True, True, False]


@pytest.mark.parametrize("device", [Device.INK, Device.FORCE])
def test_clearing_ends_a_fault_that_has_begun(world: Scripted, device: Device):
    kind = min(KINDS[device])
    world.board.hang(Fault(device=device, kind=kind, count=1000))
    world.board.due()
    assert world.board.meet(device) is not None
    assert world.board.clear() == 1
    assert world.board.meet(device) is None


def test_a_fault_has_what_its_request_says() -> None:
    fault = fault_of({"device": "camera", "kind": "black", "press": 2, "phase": "parked", "for_s": 4})
    assert (fault.device, fault.press, fault.phase, fault.for_s) == (Device.CAMERA, 2, "parked", 4.0)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "loud"}, "kind = 'loud' is not one of robot's: deaf, drop,"),
        ({"device": "coffee"}, "device: Input should be 'robot', 'telemetry'"),
        ({"device": "camera"}, "is not one of camera's: black, frozen, stale, torn"),
        ({"nht": 3}, "nht: Extra inputs are not permitted"),
        ({"nth": 0}, "nth: Input should be greater than or equal to 1 (given: '0')"),
        ({"after_s": -1}, "after_s: Input should be greater than or equal to 0"),
        ({"after_s": math.nan}, "after_s: Input should be"),
        ({"for_s": math.inf}, "for_s: Input should be"),
        ({"on": "a b"}, "on: String should match pattern"),
        ({"phase": "flying"}, "phase: Input should be 'dipping'"),
        ({"count": 1, "for_s": 1.0}, "count and for_s exclude each other"),
        ({"device": "telemetry", "on": "moveLine"}, "only the robot has methods"),
        ({"kind": "protective-stop", "count": 2}, "happens once"),
        ({"kind": "emergency-stop", "nth": 2}, "counts nothing here"),
        ({"device": "ink", "kind": "mute", "nth": 2}, "counts nothing here"),
        ({"late_s": 1.0}, "late_s goes with kind = 'late' of robot and telemetry only"),
        ({"a\nb\x1b[31m": 1}, "Extra inputs are not permitted"),
    ],
)
def test_what_cannot_be_used_is_refused_with_one_printable_line(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        fault_of({"device": "robot", "kind": "mute"} | fields)
    assert str(caught.value).isprintable()


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
