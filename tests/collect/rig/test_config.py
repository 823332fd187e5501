"""A configuration that cannot be used is one line: file, field, allowed range."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.planning.limit_check import check_protocol
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import RobotConfig, load_rig
from brushloop.drivers.sim.brush.spec import SimFileError, load_brush
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from brushloop.model.generator import TrainError
from brushloop.model.generator.config import load_config

RIG = rig_toml(SimConfig(), Addresses("127.0.0.1", 30004, 30010, 8080, 28700, "/dev/ttyUSB0"))
PROTOCOL = 'kind = "grid"\ndepths_mm = [11.0, 20.0]\ntilts_deg = [0.0, 10.0]\nrepeats = 2\n'


def rig_file(tmp_path: Path, old: str = "", new: str = "") -> Path:
    assert old in RIG
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace(old, new) if old else RIG)
    return path


def protocol_file(tmp_path: Path, text: str = PROTOCOL) -> Path:
    path = tmp_path / "protocol.toml"
    path.write_text(text)
    return path


def test_the_rig_that_the_simulator_writes_is_valid(tmp_path: Path) -> None:
    rig = load_rig(rig_file(tmp_path))
    assert rig.paper.touch_z_mm == pytest.approx(120.03)
    check_protocol(tmp_path / "rig.toml", protocol_file(tmp_path), rig, load_protocol(protocol_file(tmp_path)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("port = 30004", "port = 70000", r"rig.toml: robot.port: .*65535.*given: 70000"),
        ("radius_mm = 6.0", "radius_mm = -1.0", r"brush.radius_mm: .*greater than 0"),
        ("radius_mm = 6.0", "radius = 6.0", r"rig.toml: brush.radius: unknown field; did you mean radius_mm\?$"),
        ("[brush]", "[bursh]", r"rig.toml: bursh: unknown field; did you mean brush\?; and 1 more$"),
        ('kind = "ink-station"\n', "", r"ink.device.kind: is missing: one of 'ink-station', 'modbus-pump'$"),
        ("touch_z_mm = 120.030", "touch_z_mm = nan", r"paper.touch_z_mm: .*finite"),
        ("touch_z_mm = 120.030", "", r"paper.touch_z_mm: Field required"),
        ("x_mm = [200.0, 640.0]", "x_mm = [640.0, 200.0]", r"robot.limits: .*x_mm = \[640.0, 200.0\]"),
        ("[robot]", "[robot", r"is not TOML"),
        ("stale_ms = 100.0", "stale_ms = 3000.0", r"force: stale_ms = 3000: must be from 20 to 2000;"),
    ],
)
def test_a_bad_rig_is_refused_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        load_rig(rig_file(tmp_path, old, new))
    assert refused.value.exit_code == 2
    assert "\n" not in str(refused.value) or "TOML" in message


def test_a_real_sensor_is_never_waited_for_longer_than_a_tenth_of_a_second(tmp_path: Path) -> None:
    path = rig_file(tmp_path, 'channel = "loopback-force-board"', 'channel = "can0"')
    assert load_rig(path).force is not None
    path.write_text(path.read_text().replace("stale_ms = 100.0", "stale_ms = 100.1"))
    with pytest.raises(ConfigError, match=r"rig.toml: force: .*stale_ms = 100.1: must be from 20 to 100;"):
        load_rig(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("ROBOT__PORT", "abc", r"^environment variable BRUSHLOOP_ROBOT__PORT: robot.port: .*integer.*given: 'abc'"),
        ("INK__DEVICE__KIND", "x", r"^environment variable BRUSHLOOP_INK__DEVICE__KIND: ink.device.kind: 'x' is not"),
        ("PAPER__CELL_MM", "[40, -2]", r"^environment variable BRUSHLOOP_PAPER__CELL_MM: paper.cell_mm.1: .*greater"),
        ("PAPER", "[" * 100_000, r"environment variable BRUSHLOOP_PAPER: paper: is not JSON"),
        ("PAPER__CELL_MM", "40 x 24", r"^environment variable BRUSHLOOP_PAPER__CELL_MM: paper.cell_mm: .*valid tuple"),
        ("ROBOT__PROT", "5", r"^environment variable BRUSHLOOP_ROBOT__PROT: robot.prot: .*did you mean port\?"),
        ("ROBOT_PORT", "5", r"BRUSHLOOP_ROBOT_PORT: robot_port: unknown field; did you mean robot\?"),
        ("XYZZY", "5", r"BRUSHLOOP_XYZZY: xyzzy: unknown field; known are name, robot, "),
        (
            "PAPER__TOUCH_Z_MM",
            "500",
            r"rig.toml: motion.safe_z_mm = .*; the environment sets BRUSHLOOP_PAPER__TOUCH_Z_MM",
        ),
    ],
)
def test_a_value_from_the_environment_is_refused_by_its_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str, message: str
) -> None:
    # Another one that is in order is not blamed.
    monkeypatch.setenv("BRUSHLOOP_ROBOT__HOST", "192.0.2.7")
    monkeypatch.setenv(f"BRUSHLOOP_{name}", value)
    with pytest.raises(ConfigError, match=message) as refused:
        load_rig(rig_file(tmp_path))
    assert refused.value.exit_code == 2
    assert "ROBOT__HOST" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"kind: is missing: one of 'grid', 'few-strokes', 'list', 'replay', 'write', 'calibration'$"),
        (PROTOCOL.replace('"grid"', '"gird"'), r"kind: 'gird' is not one of 'grid', 'few-strokes', "),
        (PROTOCOL.replace("depths_mm", "depth_mm"), r"depth_mm: unknown field; did you mean depths_mm"),
        (PROTOCOL.replace("[11.0, 20.0]", "[11.0, 11.0]"), r"depths_mm: 11.0 occurs twice"),
        (PROTOCOL.replace("[0.0, 10.0]", "[-5.0]"), r"tilts_deg.0: .*greater than or equal to 0"),
        (
            PROTOCOL + "hurry = 3\n",
            r"hurry: unknown field; known are board_every, wait_after_dip_s, depths_mm, .*, seed$",
        ),
    ],
)
def test_a_bad_protocol_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_protocol(protocol_file(tmp_path, text))


@pytest.mark.parametrize(
    ("old", "new", "protocol", "message"),
    [
        ("", "", PROTOCOL.replace("20.0", "23.0"), r"depths_mm: 23 mm is deeper than brush.max_depth_mm = 22 mm"),
        ("x_mm = [200.0, 640.0]", "x_mm = [240.0, 400.0]", PROTOCOL, r"robot.limits: a planned pose is .* x = .*"),
        ("", "", PROTOCOL.replace("10.0", "20.0"), r"tilt = 20.000 deg is outside \[0.000, 15.000\]"),
        ("speed_mm_s = 250.0", "speed_mm_s = 150.0", PROTOCOL, r"speed = 200.000 mm/s is outside"),
        ("cell_mm = [40.0, 24.0]", "cell_mm = [400.0, 24.0]", PROTOCOL, r"paper.cell_mm: .* does not fit"),
    ],
)
def test_what_the_rig_cannot_do_is_refused_before_anything_is_connected(
    tmp_path: Path, old: str, new: str, protocol: str, message: str
) -> None:
    rig_path, protocol_path = rig_file(tmp_path, old, new), protocol_file(tmp_path, protocol)
    with pytest.raises(ConfigError, match=message):
        check_protocol(rig_path, protocol_path, load_rig(rig_path), load_protocol(protocol_path))


def test_a_turn_of_the_tool_is_recorded_only_where_there_is_one():
    """A session that an earlier version began has no such field, and must not look changed."""
    limits = {"x_mm": (0, 1), "y_mm": (0, 1), "z_mm": (0, 1)}
    table = {"kind": "aubo-arcs", "host": "192.0.2.7", "tcp_offset_mm": (0, 0, 180), "limits": limits}
    square = RobotConfig.model_validate(table)
    turned = square.model_copy(update={"tcp_rotation_deg": (2.0, 0.0, 0.0)})
    assert "tcp_rotation_deg" not in square.model_dump()
    assert turned.model_dump()["tcp_rotation_deg"] == (2.0, 0.0, 0.0)


DIGITS = "9" * 10_000
READERS = [
    (load_protocol, ConfigError),
    (load_rig, ConfigError),
    (lambda path: load_brush(path, 1), SimFileError),
    (load_config, TrainError),
]


@pytest.mark.parametrize(("read", "refused"), READERS, ids=["protocol", "rig", "brush", "training"])
def test_a_number_of_ten_thousand_digits_is_refused(tmp_path: Path, read: object, refused: type[Exception]) -> None:
    assert callable(read)
    path = tmp_path / "a.toml"
    path.write_text(f"seed = {DIGITS}\n")
    with pytest.raises(refused, match=r"a\.toml: .*TOML"):
        read(path)
