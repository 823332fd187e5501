"""The maker's own client against the loopback controller: what it accepts is the best that is known of the wire."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import LoopbackRig
from tests.waiting import PATIENCE_S

pytestmark = [
    pytest.mark.xdist_group("vendor"),  # one session for all of them
    pytest.mark.skipif(
        importlib.util.find_spec("pyaubo_sdk") is None,
        reason="the maker's client is not installed: pip install 'brushloop[vendor]' (Python 3.11 or 3.12)",
    ),
]

SESSION = Path(__file__).with_name("session.py")


TRIES = 4
"""The client's own library can die of a race: it holds the interpreter while it waits for RTDE, whose callback needs
it. Only a death by signal is tried again, never a wrong answer."""


async def run_session() -> dict[str, Any]:
    for _ in range(TRIES):
        returncode, text, pings = await one_session()
        if returncode >= 0:
            break
    assert returncode == 0, text
    return {**json.loads(text.strip().splitlines()[-1]), "pings": pings}


async def one_session() -> tuple[int, str, int]:
    """(exit code, negative for a signal; everything it printed; RTDE pings that the server saw)."""
    async with LoopbackRig(SimConfig(rate=5.0)) as rig:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            str(SESSION),
            str(rig.arcs.port),
            str(rig.rtde.port),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        try:
            async with asyncio.timeout(PATIENCE_S):
                output, _ = await process.communicate()
        except TimeoutError:
            process.kill()
            await process.communicate()
            raise
        assert process.returncode is not None
        return process.returncode, output.decode(errors="replace"), rig.rtde.pings


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """What one whole session saw; run once for all tests."""
    return asyncio.run(run_session())


def test_it_connects_logs_in_and_learns_names(seen: dict[str, Any]):
    assert seen["connect"] == 0
    assert seen["login"] == [0, True]
    assert seen["names"] == ["rob1"]
    assert seen["versions"] == [24000, 31001]
    assert seen["types"][0] == "aubo_i5"
    assert seen["types"][2:] == ["brushloop-loopback", 6]
    assert seen["connected at the end"] is False


def test_what_it_sets_it_gets_back(seen: dict[str, Any]):
    assert seen["tcp"] == [0, [0.0, 0.0, 0.18, 0.0, 0.0, 0.0]]
    assert seen["payload"] == [0, [0.5, [0.0, 0.0, 0.05], [0.0] * 3, [0.0] * 6]]
    assert seen["collision"] == [0, 7]
    assert seen["operational"] == [True, True]


def test_it_is_refused_without_power_and_powers_the_arm(seen: dict[str, Any]):
    assert seen["mode before"] == "RobotModeType.PowerOff"
    assert seen["refused"] == -1
    assert seen["idle"]
    assert seen["running"]
    assert seen["safety"] == "SafetyModeType.Normal"
    assert seen["power on"] is True
    assert seen["power off"] == 0


def test_it_moves_waits_by_exec_id_and_hears_that_it_has_arrived(seen: dict[str, Any]):
    code, ident = seen["move"]
    assert code == 0
    assert ident >= 0
    assert seen["queue"] == 1
    assert seen["arrived"]
    assert seen["moved by"] == pytest.approx(0.05, abs=1e-6)
    assert seen["same"] == 13


@pytest.mark.parametrize("way", ["stopLine", "abort"])
def test_it_stops_the_arm_in_mid_move(seen: dict[str, Any], way: str):
    code, at_rest, travelled_m = seen[way]
    assert code == 0
    assert at_rest
    assert 0.0 < travelled_m < 0.039


def test_it_pauses_and_resumes(seen: dict[str, Any]):
    assert seen["pause"] == [0, "RuntimeState.Paused", True]
    assert seen["resume"] == [0, "RuntimeState.Stopped", True]
    assert seen["fraction"] == [0, 0.5, 0]


def test_its_kinematics_go_there_and_back(seen: dict[str, Any]):
    for name, tolerance in (("fk", 1e-6), ("ik", 1e-5)):
        code, off = seen[name]
        assert code == 0
        assert off < tolerance
    assert seen["ik far"] < 0
    assert seen["joint move"] == 0
    assert seen["joints off"] < 1e-5


def test_its_moves_are_rounded_into_each_other(seen: dict[str, Any]):
    assert seen["blend sent"] == [0, 0]
    assert seen["blend start"] == 0
    nearest_m, ids, off_m = seen["blend"]
    assert 0.001 < nearest_m < 0.015
    assert ids == 2
    assert off_m < 1e-6


def test_it_reads_what_is_behind_the_controller_and_sets_a_watchdog(seen: dict[str, Any]):
    assert seen["version"] == "0.31.1-brushloop-loopback"
    assert seen["joint state"] == ["JointStateType.Running"] * 6
    assert seen["simulated"] is True
    assert seen["watchdog"] == [0, 0]


def test_it_subscribes_to_telemetry(seen: dict[str, Any]):
    assert seen["rtde connect"] == [0, 0]
    assert seen["rtde outputs"]["R1_actual_TCP_pose"] == 1021
    assert seen["rtde topic"] == [0, 0]
    count, q, pose, running, normal = seen["rtde pushed"]
    assert count >= 10
    assert (len(q), len(pose)) == (6, 6)
    assert running
    assert normal
    assert seen["rtde removed"] == 0
    assert seen["pings"] >= 1
    assert seen["rtde connected"] is True


def test_what_goes_wrong_is_reported_as_the_client_expects(seen: dict[str, Any]):
    assert seen["unknown method"].startswith("AuboException: rob1.MotionControl.getEqradius--32601")
    assert seen["wrong call"].startswith("AuboException: rob1.RobotAlgorithm.forwardKinematics--32602")
    assert seen["out of reach"] == 0
    assert seen["messages"] == [[30047, "TraceLevel.ERROR", "rob1"]]
