"""Two rigs, one session: the second process is refused and powers nothing; the first does not notice."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

import pytest

from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.sessions.verify import verify_session
from tests.collect.durability.conftest import the_session
from tests.command import brushloop
from tests.rigs import SMALL_VIEW, serving
from tests.waiting import PATIENCE_S, wait_until

if TYPE_CHECKING:
    from tests.rigs import Lab


def where(rig: LoopbackRig) -> dict[str, str]:
    """The environment that points a configuration at this rig's devices: machine names may differ in a session."""
    devices = tomllib.loads(rig.toml())
    return {
        "BRUSHLOOP_ROBOT__PORT": str(devices["robot"]["port"]),
        "BRUSHLOOP_ROBOT__RTDE_PORT": str(devices["robot"]["rtde_port"]),
        "BRUSHLOOP_CAMERA__SOURCE": devices["camera"]["source"],
        "BRUSHLOOP_FORCE__PORT": str(devices["force"]["port"]),
        "BRUSHLOOP_INK__DEVICE__PORT": devices["ink"]["device"]["port"],
    }


def test_a_session_that_is_open_elsewhere_is_refused_before_anything_is_powered(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.write_protocol(repeats=3)
    protocol = lab.folder / "protocol.toml"  # each press takes a second: the first run outlives the second
    protocol.write_text(protocol.read_text().replace("dwell_s = 0.0", "dwell_s = 60.0"))
    with serving(SimConfig(rate=60.0, view=SMALL_VIEW)) as rig:
        first = lab.process()
        wait_until(lambda: lab.rig.world.presses, "the first press")
        for name, value in where(rig).items():
            monkeypatch.setenv(name, value)
        second = brushloop("collect", "--no-tui", *lab.options)  # this process is the second
        assert second.returncode == 2, second.stderr
        assert second.stderr.splitlines()[-1].endswith("another brushloop has this session open")
        assert rig.arcs.cabinet.power.mode == "PowerOff"
        assert not rig.world.presses
    _, stderr = first.communicate(timeout=PATIENCE_S)
    assert first.returncode == 0, stderr
    assert verify_session(the_session(lab)).sound
