"""When a fault begins, what it strikes, and when it is over."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from brushloop.drivers.sim.faults import KINDS, MOST, REPLIES, STOPS, Device, Fault, FaultBoard, Phase


@dataclass
class Scripted:
    """A world whose state is set by the test, and a clock."""

    presses: int = 0
    sim_s: float = 0.0
    doing: Phase = Phase.PARKED
    real_s: float = 0.0
    board: FaultBoard = field(init=False)

    def __post_init__(self) -> None:
        self.board = FaultBoard(self, lambda: self.real_s)

    def now_s(self) -> float:
        return self.sim_s

    def phase(self) -> Phase:
        return self.doing

    def strikes(self, *ops: str) -> list[bool]:
        return [self.board.meet(Device.ROBOT, op, REPLIES) is not None for op in ops]


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


def test_of_two_that_match_the_first_strikes(world: Scripted):
    world.board.hang(mute())
    world.board.hang(Fault(device=Device.ROBOT, kind="drop"))
    kinds = [world.board.meet(Device.ROBOT, "x", REPLIES) for _ in range(3)]
    assert [fault.kind if fault else None for fault in kinds] == ["mute", "drop", None]


def test_faults_of_other_devices_and_kinds_wait(world: Scripted):
    world.board.hang(Fault(device=Device.TELEMETRY, kind="mute"))
    world.board.hang(Fault(device=Device.ROBOT, kind="deaf"))
    assert world.strikes("x") == [False]
    assert len(world.board.hanging) == 2


@pytest.mark.parametrize(
    "fault",
    [
        Fault(device=Device.ROBOT, kind="protective-stop", phase=Phase.LIFTING),
        Fault(device=Device.ROBOT, kind="emergency-stop", phase=Phase.LIFTING),
    ],
)
def test_a_stop_begins_by_itself_and_once(world: Scripted, fault: Fault):
    world.board.hang(fault)
    assert world.board.waits_by_itself
    assert world.board.meet(fault.device, "x", KINDS[fault.device]) is None
    assert world.board.due() == []
    world.doing = Phase.LIFTING
    assert world.board.due() == [fault]
    assert world.board.due() == []
    assert not world.board.waits_by_itself


def test_a_fault_of_ink_begins_by_itself_and_strikes_the_requests_that_follow(world: Scripted):
    world.board.hang(Fault(device=Device.INK, kind="garbage", phase=Phase.LIFTING, count=2))
    assert world.board.due() == []
    assert world.board.meet(Device.INK, "", KINDS[Device.INK]) is None
    world.doing = Phase.LIFTING
    world.board.due()
    world.doing = Phase.PARKED
    assert not world.board.waits_by_itself
    strikes = [world.board.meet(Device.INK, "", KINDS[Device.INK]) is not None for _ in range(3)]
    assert strikes == [True, True, False]


@pytest.mark.parametrize("device", [Device.INK, Device.FORCE])
def test_clearing_ends_a_fault_that_has_begun(world: Scripted, device: Device):
    kind = min(KINDS[device])
    world.board.hang(Fault(device=device, kind=kind, count=1000))
    world.board.due()
    assert world.board.meet(device, "", KINDS[device]) is not None
    assert world.board.clear() == 1
    assert world.board.meet(device, "", KINDS[device]) is None


def test_a_stop_on_a_method_waits_for_it(world: Scripted):
    world.board.hang(Fault(device=Device.ROBOT, kind="emergency-stop", on="moveLine"))
    assert world.board.due() == []
    assert world.board.meet(Device.ROBOT, "rob1.MotionControl.moveLine", STOPS) is not None


def test_faults_are_taken_down_one_by_one_or_all_at_once(world: Scripted):
    first, second = world.board.hang(mute()), world.board.hang(mute())
    assert world.board.take(first)
    assert not world.board.take(first)
    assert world.board.clear() == 1
    assert world.strikes("x") == [False]
    assert second > first


def test_a_board_is_not_filled_without_end(world: Scripted):
    for _ in range(MOST):
        world.board.hang(mute(after_s=1e6))
    with pytest.raises(ValueError, match="already 1000 faults"):
        world.board.hang(mute())
