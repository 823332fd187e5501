"""Faults of the rig: when one begins, what it strikes, and when it is over."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import pytest

from brushloop.drivers.sim.faults import FaultBoard, Phase, fault_of

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
    monkeypatch: pytest.MonkeyPatch, fault: dict[str, Any], moments: list[tuple[dict[str, Any], str, list[bool]]]
) -> None:
    # As much of a world as the board looks at: its presses, its clock, and what the arm is doing.
    world: Any = SimpleNamespace(at_s=0.0, doing=Phase.PARKED, presses=[])
    world.clock = SimpleNamespace(real_s=lambda: world.at_s)
    monkeypatch.setattr(FaultBoard, "phase", lambda _: world.doing)
    board, hung = FaultBoard(world), fault_of({"device": "robot", "kind": "mute"} | fault)
    board.hang(hung)
    for changes, ops, expected in moments:
        vars(world).update(changes)
        board.begin_due(lambda _mode: None)
        assert [board.meet(hung.device, op) is not None for op in ops.split()] == expected
    assert board.strikes == sum(sum(expected) for _, _, expected in moments)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "loud"}, "kind = 'loud' is not one of robot's: deaf, drop,"),
        ({"device": "telemetry", "on": "moveLine"}, "only the robot has methods"),
        ({"kind": "emergency-stop", "nth": 2}, "counts nothing here"),
        ({"a\nb\x1b[31m": 1}, "Extra inputs are not permitted"),
    ],
)
def test_what_cannot_be_used_is_refused_with_one_printable_line(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        fault_of({"device": "robot", "kind": "mute"} | fields)
    assert str(caught.value).isprintable()
