"""faults.toml: read as written, or refused with one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.sim.described import MAX_BYTES, SimFileError
from drivers.sim.faults.kinds import Device, fault_of, hang_script, load_faults

SCRIPT = """
[[fault]]
device = "robot"
kind = "late"
on = "moveLine"
nth = 3
late_s = 0.5

[[fault]]
device = "camera"
kind = "black"
press = 2
phase = "parked"
for_s = 4
"""


def script(folder: Path, text: str | bytes) -> Path:
    path = folder / "faults.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_script_is_read_in_order(tmp_path: Path):
    late, black = load_faults(script(tmp_path, SCRIPT))
    assert (late.device, late.kind, late.on, late.nth, late.late_s) == (Device.ROBOT, "late", "moveLine", 3, 0.5)
    assert (black.press, black.phase, black.for_s, black.strikes) == (2, "parked", 4.0, None)
    assert load_faults(script(tmp_path, "")) == ()


def one(**fields: object) -> str:
    values = {"device": "robot", "kind": "mute"} | fields
    return "[[fault]]\n" + "\n".join(f"{name} = {value!r}" for name, value in values.items())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fault = 3", "fault: Input should be a valid list"),
        ("[fault]\ndevice = 'robot'", "fault: Input should be a valid list"),
        ("oops", "is not TOML"),
        (b"\xff\xfe", "is not TOML"),
        ("[[faults]]\nkind = 'mute'", "faults: Extra inputs are not permitted"),
        ("[[fault]]\ndevice = 'robot'", "fault.0.kind: Field required"),
        (one(kind="loud"), "fault.0: kind = 'loud' is not one of robot's: deaf, drop,"),
        (one(device="coffee"), "fault.0.device: Input should be 'robot', 'telemetry'"),
        (one(device="camera"), "is not one of camera's: black, drop, frozen, stale, torn"),
        (one(nht=3), "fault.0.nht: Extra inputs are not permitted"),
        (one(nth=0), "fault.0.nth: Input should be greater than or equal to 1 (given: '0')"),
        (one(after_s=-1), "fault.0.after_s: Input should be greater than or equal to 0"),
        (one() + "\nafter_s = nan", "fault.0.after_s: Input should be"),
        (one() + "\nfor_s = inf", "fault.0.for_s: Input should be"),
        (one(on="a b"), "fault.0.on: String should match pattern"),
        (one(phase="flying"), "fault.0.phase: Input should be 'dipping'"),
        (one(count=1, for_s=1.0), "count and for_s exclude each other"),
        (one(device="telemetry", on="moveLine"), "only the robot has methods"),
        (one(kind="protective-stop", count=2), "happens once"),
        (one(kind="emergency-stop", nth=2), "counts nothing here"),
        (one(device="ink", kind="mute", nth=2), "counts nothing here"),
        (one(late_s=1.0), "late_s goes with device = 'robot', kind = 'late' only"),
    ],
)
def test_what_cannot_be_used_is_refused_with_one_line_that_names_it(tmp_path: Path, text: str | bytes, words: str):
    path = script(tmp_path, text)
    with pytest.raises(SimFileError) as caught:
        load_faults(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_file_that_is_not_there_or_far_too_long_is_refused(tmp_path: Path):
    with pytest.raises(SimFileError, match="no such file"):
        load_faults(tmp_path / "faults.toml")
    with pytest.raises(SimFileError, match="larger than"):
        load_faults(script(tmp_path, b"#" * (MAX_BYTES + 1)))


def test_a_fault_that_the_rig_does_not_take_is_named_by_its_place(tmp_path: Path):
    path = script(tmp_path, SCRIPT)

    def refuse(_: object) -> int:
        raise ValueError("this rig has none")

    with pytest.raises(SimFileError, match=r"fault\.0: this rig has none"):
        hang_script(path, refuse, load_faults(path))


def test_made_up_keys_of_a_client_come_back_as_one_printable_line():
    with pytest.raises(ValueError, match="Extra inputs") as caught:
        fault_of({"device": "robot", "kind": "mute", "a\nb\x1b[31m": 1})
    assert str(caught.value).isprintable()
