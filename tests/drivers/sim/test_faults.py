"""Faults of the rig: when one begins, what it strikes, and when it is over; and the phases of the arm."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.faults import Device, FaultBoard, Phase, fault_of, phase_of
from brushloop.drivers.sim.world import SimClock, World
from tests.simulated_time import SimulatedTime


class Scripted(FaultBoard):
    """A board over a world whose state is set by the test, and a clock."""

    def __init__(self) -> None:
        self.at_s = 0.0
        self.doing = Phase.PARKED
        self.presses: list[None] = []
        self.clock = self
        super().__init__(self)  # type: ignore[arg-type]

    def real_s(self) -> float:
        return self.at_s

    def phase(self) -> Phase:
        return self.doing

    def strikes_on(self, device: Device, ops: str) -> list[bool]:
        self.begin_due(lambda _mode: None)
        return [self.meet(device, op) is not None for op in ops.split()]


ARM = "rob1.MotionControl."


@pytest.mark.parametrize(
    ("fault", "moments"),
    [
        ({}, [({}, "a b", [True, False])]),
        ({"on": "moveLine"}, [({}, f"{ARM}getExecId {ARM}moveLines {ARM}moveLine", [False, False, True])]),
        ({"on": f"{ARM}moveLine"}, [({}, f"moveLine {ARM}moveLine", [False, True])]),
        (
            {"on": "x", "nth": 2, "phase": "descending", "count": 2},
            [
                ({}, "x x", [False, False]),
                ({"doing": Phase.DESCENDING}, "x y x", [False, False, True]),
                ({"doing": Phase.PARKED}, "y x x", [False, True, False]),  # once begun it goes on
            ],
        ),
        ({"press": 3}, [({"presses": [None] * 4}, "x", [False]), ({"presses": [None] * 3}, "x", [True])]),
        (
            {"for_s": 2.0},  # from its beginning
            [({"at_s": 100.0}, "x x", [True, True]), ({"at_s": 101.9}, "x", [True]), ({"at_s": 102.0}, "x", [False])],
        ),
        ({"for_s": 2.0, "count": 1}, [({}, "x x", [True, False])]),
        (
            {"device": "ink", "kind": "garbage", "phase": "lifting", "count": 2},  # begins without a request
            [
                ({}, "x", [False]),
                ({"doing": Phase.LIFTING}, "", []),
                ({"doing": Phase.PARKED}, "x x x", [True, True, False]),
            ],
        ),
    ],
)
def test_a_fault_strikes_the_requests_that_its_conditions_name(
    fault: dict[str, Any], moments: list[tuple[dict[str, Any], str, list[bool]]]
) -> None:
    board, hung = Scripted(), fault_of({"device": "robot", "kind": "mute"} | fault)
    board.hang(hung)
    for changes, ops, expected in moments:
        vars(board).update(changes)
        assert board.strikes_on(hung.device, ops) == expected
    assert board.strikes == sum(sum(expected) for _, _, expected in moments)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "loud"}, "kind = 'loud' is not one of robot's: deaf, drop,"),
        ({"device": "coffee"}, "device: Input should be 'robot', 'telemetry'"),
        ({"nth": 0}, "nth: Input should be greater than or equal to 1"),
        ({"device": "telemetry", "on": "moveLine"}, "only the robot has methods"),
        ({"kind": "emergency-stop", "nth": 2}, "counts nothing here"),
        ({"a\nb\x1b[31m": 1}, "Extra inputs are not permitted"),
    ],
)
def test_what_cannot_be_used_is_refused_with_one_printable_line(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        Scripted().hang(fault_of({"device": "robot", "kind": "mute"} | fields))
    assert str(caught.value).isprintable()


TABLE = Table()
HOME, OVER, NEAR, ON, IN, WELL, INK = (
    brush_pose(*place)
    for place in (
        SimConfig().home_mm,
        *(TABLE.to_base(100.0, 80.0, above_mm) for above_mm in (60.0, 8.0, 0.03, -15.0)),
        *(TABLE.to_base(*TABLE.well_mm, above_mm) for above_mm in (60.0, 2.0)),
    )
)
JOURNEY = (
    (HOME, Phase.PARKED, Phase.PARKED),
    (OVER, Phase.TRAVELLING, Phase.RESTING),
    (NEAR, Phase.TRAVELLING, Phase.RESTING),  # the fast approach ends above the paper
    (ON, Phase.DESCENDING, Phase.PRESSED),
    (IN, Phase.DESCENDING, Phase.PRESSED),
    (NEAR, Phase.LIFTING, Phase.RESTING),
    (OVER, Phase.LIFTING, Phase.RESTING),
    (WELL, Phase.TRAVELLING, Phase.RESTING),
    (INK, Phase.DIPPING, Phase.DIPPING),
    (WELL, Phase.DIPPING, Phase.RESTING),
    (HOME, Phase.TRAVELLING, Phase.PARKED),
)
"""Where the arm is sent next, and its phases as it sets out and once it is there."""


def phases(poses: Iterable[Pose], table: Table = TABLE) -> Iterator[tuple[Phase, Phase]]:
    time = SimulatedTime()
    world = World(SimConfig(table=table), SimClock(real_s=time.seconds))
    for pose in poses:
        world.motion.add(pose, 200.0, 1000.0, world.clock.now_s())
        setting_out = phase_of(world)
        time.pass_s(100.0)
        yield setting_out, phase_of(world)


def test_each_piece_of_a_press_and_of_a_dip_has_its_phases() -> None:
    assert list(phases(pose for pose, *_ in JOURNEY)) == [(there, then) for _, there, then in JOURNEY]


@pytest.mark.parametrize(("above_mm", "phase"), [(3.0, Phase.RESTING), (0.05, Phase.PRESSED), (-2.0, Phase.PRESSED)])
@pytest.mark.parametrize("corner_mm", [(230.0, 10.0), (10.0, 160.0)])
def test_on_a_sloping_sheet_heights_count_from_the_paper_under_the_tip(
    corner_mm: tuple[float, float], above_mm: float, phase: Phase
) -> None:
    table = Table(yaw_deg=0.0, slope_deg=(1.0, -1.0))
    [(_, at_rest)] = phases([brush_pose(*table.to_base(*corner_mm, above_mm))], table)
    assert at_rest is phase
