"""The maker's own client against the loopback controller: what it accepts is the best that is known of the wire."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import LoopbackRig
from tests.rigs import in_thread
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pyaubo_sdk") is None,
    reason="the maker's client is not installed: pip install 'brushloop[vendor]' (Python 3.11 or 3.12)",
)

ROOT = Path(__file__).parents[2]

TRIES = 4
"""The client's own library can die of a race: it holds the interpreter while it waits for RTDE, whose callback needs
it. Only a death by signal is tried again, never a wrong answer."""

ANSWERS: dict[str, Any] = {
    "connect": 0,
    "login": [0, True],
    "names": ["rob1"],
    "versions": [24000, 31001],
    "types": ["aubo_i5", "aubo_i5_11", "brushloop-loopback", 6],
    # what it sets it gets back
    "tcp": [0, [0.0, 0.0, 0.18, 0.0, 0.0, 0.0]],
    "payload": [0, [0.5, [0.0, 0.0, 0.05], [0.0] * 3, [0.0] * 6]],
    "collision": [0, 7],
    "operational": [True, True],
    # it is refused without power, and powers the arm
    "mode before": "RobotModeType.PowerOff",
    "refused": -1,
    "safety": "SafetyModeType.Normal",
    "power on": True,
    # it waits by the id of the running line, and to be there already is no error
    "queue": 1,
    "move": [0, True],
    "same": 13,
    # either stop ends a move of 40 mm on its way
    "stopLine": [0, pytest.approx(0.02, abs=0.019)],
    "abort": [0, pytest.approx(0.02, abs=0.019)],
    "pause": [0, "RuntimeState.Paused", True],
    "resume": [0, "RuntimeState.Stopped"],
    "fraction": [0, 0.5, 0],
    # its kinematics go there and back
    "moved by": pytest.approx(0.05, abs=1e-6),
    "fk": [0, pytest.approx(0.0, abs=1e-6)],
    "ik": [0, pytest.approx(0.0, abs=1e-5)],
    "ik far": -23,
    "joint move": 0,
    "joints off": pytest.approx(0.0, abs=1e-5),
    # the nearest that it comes to a corner of 15 mm, the lines that it has begun, and how far from the end it rests
    "blend sent": [0, 0],
    "blend start": 0,
    "blend": [pytest.approx(0.008, abs=0.007), 2, pytest.approx(0.0, abs=1e-6)],
    "version": "0.31.1-brushloop-loopback",
    "joint state": ["JointStateType.Running"] * 6,
    "simulated": True,
    "rtde connect": [0, 0],
    "rtde pose": 1021,
    "rtde topic": [0, 0],
    # the tenth sample has six joints and a pose of six numbers
    "rtde pushed": [6, 6, True, True],
    "rtde removed": 0,
    "rtde connected": True,
    "unknown method": "AuboException: rob1.MotionControl.getEqradius--32601",
    "wrong call": "AuboException: rob1.RobotAlgorithm.forwardKinematics--32602",
    "out of reach": 0,
    "messages": [[30047, "TraceLevel.ERROR", "rob1"]],
    "power off": 0,
    "connected at the end": False,
}


def test_each_step_of_a_session_is_answered_as_by_a_cabinet() -> None:
    for _ in range(TRIES):
        with in_thread(LoopbackRig(SimConfig(rate=5.0))) as (rig, _):
            command = [sys.executable, "-m", "tests.vendor.session", str(rig.arcs.port), str(rig.rtde.port)]
            ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        if ran.returncode >= 0:
            break
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert json.loads(ran.stdout.strip().splitlines()[-1]) == ANSWERS
    assert rig.rtde.pings >= 1
