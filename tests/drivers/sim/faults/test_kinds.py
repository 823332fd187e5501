"""A fault from a request: taken as it is given, or refused with one line."""

from __future__ import annotations

import math
import re

import pytest

from brushloop.drivers.sim.faults import Device, fault_of


def test_a_fault_has_what_its_request_says() -> None:
    fault = fault_of({"device": "camera", "kind": "black", "press": 2, "phase": "parked", "for_s": 4})
    assert (fault.device, fault.press, fault.phase, fault.for_s) == (Device.CAMERA, 2, "parked", 4.0)
    assert fault.strikes is None


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "loud"}, "kind = 'loud' is not one of robot's: deaf, drop,"),
        ({"device": "coffee"}, "device: Input should be 'robot', 'telemetry'"),
        ({"device": "camera"}, "is not one of camera's: black, drop, frozen, stale, torn"),
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
