"""What a chain of commands keeps, and what it refuses before anything moves; no rig."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.chains.commands import finished_session
from brushloop.collect.chains.loop import SETTINGS as FILE
from brushloop.collect.chains.loop import Settings, begun_with, check_recovered, keep_settings
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from tests.sessions.conftest import Make

SETTINGS = Settings(
    original="grid-01",
    original_sha256="ab",
    fit="cd",
    depth_range_mm=(2.0, 22.0),
    tilt_range_deg=(0.0, 15.0),
    repeats=1,
    seed=1,
)


def test_a_loop_goes_on_with_what_it_was_begun_with_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "loop"
    assert begun_with(folder) is None
    keep_settings(SETTINGS, folder)
    keep_settings(SETTINGS, folder)
    assert begun_with(folder) == SETTINGS
    for name, value in (("fit", "ef"), ("original_sha256", "xy"), ("depth_range_mm", (2.0, 20.0)), ("presses", 5)):
        with pytest.raises(ConfigError, match=f"{name}: this loop was begun with"):
            keep_settings(SETTINGS.model_copy(update={name: value}), folder)
    (folder / FILE).write_text("{}")
    with pytest.raises(ConfigError, match="does not hold the settings of a loop"):
        keep_settings(SETTINGS, folder)


def test_a_fit_that_does_not_describe_the_brush_is_not_pressed(tmp_path: Path) -> None:
    path = tmp_path / "recovered.csv"
    path.write_text("stroke_id,flags\na,\nb,at_bound\nc,\nd,at_bound\n")
    check_recovered(path)
    path.write_text("stroke_id,flags\na,\nb,at_bound\nc,upright at_bound\n")
    with pytest.raises(ConfigError, match="2 of 3 presses were recovered at a bound") as caught:
        check_recovered(path)
    assert caught.value.exit_code == 2
    path.write_bytes(b"stroke_id,flags\n\xff,\n")
    with pytest.raises(ConfigError, match=r"recovered\.csv: is not UTF-8 at byte 16"):
        check_recovered(path)


def test_a_session_of_another_ink_is_not_the_one_that_a_chain_asks_for(tmp_path: Path) -> None:
    """The same protocol was pressed with two inks: each rig.toml finds its own session, and a third ink finds none."""
    protocol = tmp_path / "protocol.toml"
    protocol.write_text('kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nrepeats = 1\nseed = 1\n')
    rigs = {ink: tmp_path / f"{ink}.toml" for ink in ("sumi", "walnut", "red")}
    text = rig_toml(SimConfig(), Addresses("127.0.0.1", 30004, 30010, 8080, 28700, "/dev/ttyUSB0"))
    for ink, path in rigs.items():
        path.write_text(text.replace("simulated ink", ink), encoding="utf-8")
    root = tmp_path / "sessions"
    for number, ink in enumerate(("sumi", "walnut"), 1):
        rig = load_rig(rigs[ink])
        known = {"brush": rig.brush.name, "ink": rig.ink.name, "paper": rig.paper.name}
        asked = {"session_id": f"grid-{number}", "protocol": load_protocol(protocol).model_dump_json()}
        Make().session(root / f"grid-{number}", closed=True, **known, **asked)
    assert finished_session(root, rigs["sumi"], protocol) == root / "grid-1"
    assert finished_session(root, rigs["walnut"], protocol) == root / "grid-2"
    assert finished_session(root, rigs["red"], protocol) is None
