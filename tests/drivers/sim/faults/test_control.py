"""Live control of a rig over its socket, and from the command line."""

from __future__ import annotations

import asyncio
import json
import stat
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.loopback import FaultRefused, request_of
from brushloop.drivers.loopback import ask as ask_rig
from brushloop.drivers.sim.brush.spec import SimFileError
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.drivers.sim.serve import MAX_LINE_BYTES, ControlServer, live_control
from tests.waiting import PATIENCE_S, wait_until

Ask = Callable[[object], Awaitable[dict[str, Any]]]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "control"


@pytest.fixture
async def control(rig: LoopbackRig, path: Path) -> AsyncIterator[ControlServer]:
    server = ControlServer(rig)
    await server.open(path)
    yield server
    await server.stop()
    assert not path.exists()


@pytest.fixture
async def ask(control: ControlServer, path: Path) -> AsyncIterator[Ask]:
    reader, writer = await asyncio.open_unix_connection(str(path))

    async def exchange(request: object) -> dict[str, Any]:
        writer.write((request if isinstance(request, bytes) else json.dumps(request).encode()) + b"\n")
        async with asyncio.timeout(3.0):
            return json.loads(await reader.readline())

    yield exchange
    writer.close()
    await writer.wait_closed()


async def test_a_fault_is_hung_listed_and_taken_down(ask: Ask, rig: LoopbackRig):
    fault = {"device": "robot", "kind": "mute", "on": "moveLine", "nth": 2}
    assert await ask({"do": "add", "fault": fault}) == {"ok": True, "id": 1}
    assert (await ask({"do": "list"}))["hanging"] == [{"id": 1, "fault": fault, "struck": 0}]
    assert await ask({"do": "clear", "id": 7}) == {"ok": True, "taken": 0}
    assert await ask({"do": "clear", "id": 1}) == {"ok": True, "taken": 1}
    await ask({"do": "add", "fault": fault})
    assert await ask({"do": "clear"}) == {"ok": True, "taken": 1}
    assert not rig.faults.hanging


async def test_the_state_is_what_the_world_knows(ask: Ask):
    state = await ask({"do": "state"})
    assert state["ok"]
    assert (state["phase"], state["moving"], state["presses"], state["ink_load"]) == ("parked", False, 0, 0.0)
    assert (state["robot_mode"], state["safety_mode"], state["faults"]) == ("PowerOff", "Normal", 0)
    assert state["tip_mm"] == [250.0, -230.0, 260.0]


@pytest.mark.parametrize(
    ("kind", "mode"),
    [
        ("protective-stop", SafetyMode.PROTECTIVE_STOP),
        ("safeguard-stop", SafetyMode.SAFEGUARD_STOP),
        ("emergency-stop", SafetyMode.ROBOT_EMERGENCY_STOP),
    ],
)
async def test_a_person_ends_a_stop_that_was_asked_for(ask: Ask, kind: str, mode: SafetyMode):
    await ask({"do": "add", "fault": {"device": "robot", "kind": kind}})
    async with asyncio.timeout(2.0):
        while (await ask({"do": "state"}))["safety_mode"] != mode:
            await asyncio.sleep(0.005)
    assert await ask({"do": "release"}) == {"ok": True, "was": mode.value}
    assert (await ask({"do": "state"}))["safety_mode"] == "Normal"
    assert await ask({"do": "release"}) == {"ok": True, "was": "Normal"}


REFUSED: list[tuple[object, str]] = [
    (b"hello", "not JSON"),
    (b"", "not JSON"),
    (b"\xff\xfe", "not JSON"),
    (b"[" * 5000, "not JSON"),
    (b"[]", "not a request"),
    (b"null", "not a request"),
    ({"do": "explode"}, "not a request"),
    ({"do": ["add"]}, "not a request"),
    ({"do": "state", "more": 1}, "not a request"),
    ({"do": "clear", "id": "1"}, "not a request"),
    ({"do": "clear", "id": True}, "not a request"),
    ({"do": "add"}, "not a request"),
    ({"do": "add", "fault": 3}, "not a request"),
    ({"do": "add", "fault": {}}, "Field required"),
    ({"do": "add", "fault": {"device": "robot", "kind": "loud"}}, "is not one of robot's"),
    ({"do": "add", "fault": {"device": "robot", "kind": "mute", "count": 1e30}}, "count"),
]


@pytest.mark.parametrize(("request_", "words"), REFUSED, ids=range(len(REFUSED)))
async def test_what_is_no_request_gets_one_line_and_the_next_is_answered(ask: Ask, request_: object, words: str):
    answer = await ask(request_)
    assert not answer["ok"]
    assert words in answer["error"]
    assert answer["error"].isprintable()
    assert (await ask({"do": "state"}))["ok"]


async def test_a_line_without_end_is_refused_and_hung_up_on(control: ControlServer, path: Path, ask: Ask):
    reader, writer = await asyncio.open_unix_connection(str(path))
    writer.write(b"x" * (4 * MAX_LINE_BYTES))
    assert b"at most" in await reader.readline()
    assert await reader.read() == b""
    writer.close()
    await writer.wait_closed()
    assert (await ask({"do": "state"}))["ok"]


async def test_only_its_owner_can_open_it(control: ControlServer, path: Path):
    mode = path.stat().st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600


async def test_what_stands_at_the_path_is_not_overwritten(rig: LoopbackRig, path: Path):
    path.write_text("mine")
    with pytest.raises(SimFileError, match="exists and is not a socket"):
        async with live_control(rig, path):
            pass
    assert path.read_text() == "mine"


async def test_two_rigs_do_not_share_a_socket_and_one_that_is_dead_is_replaced(rig: LoopbackRig, path: Path):
    async with live_control(rig, path):
        with pytest.raises(SimFileError, match="another rig listens here"):
            await ControlServer(rig).open(path)
        path.rename(f"{path}.old")
    assert Path(f"{path}.old").exists()  # what it did not find at its path it left alone
    Path(f"{path}.old").rename(path)
    async with live_control(rig, path):
        _, writer = await asyncio.open_unix_connection(str(path))
        writer.close()
        await writer.wait_closed()


async def test_a_path_that_the_system_would_cut_is_refused(rig: LoopbackRig, tmp_path: Path):
    for path, words in ((tmp_path / ("x" * 120), "at most"), (tmp_path / "no" / "where", "cannot listen here")):
        with pytest.raises(SimFileError, match=words) as caught:
            await ControlServer(rig).open(path)
        assert caught.value.exit_code == 2


NOTHING: dict[str, object] = {"on": None, "count": None, "id": None}


def brushloop(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "brushloop", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "control"
    command = [sys.executable, "-m", "brushloop", "sim", "--control", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_until(path.exists, "the control socket", process=process)
    yield path
    process.terminate()
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert stderr == ""
    assert not path.exists()


def test_a_person_breaks_the_rig_and_mends_it(served: Path):
    added = brushloop("fault", served, "robot", "mute", "--on", "moveLine", "--count", "3")
    assert json.loads(added.stdout) == {"id": 1}, added.stderr
    refused = brushloop("fault", served, "robot", "loud")
    assert refused.returncode == 2
    assert refused.stderr.startswith("brushloop: kind = 'loud' is not one of robot's")
    assert refused.stderr.count("\n") == 1
    assert json.loads(brushloop("fault", served, "clear").stdout) == {"taken": 1}


def test_the_words_of_a_command_line_become_a_request():
    assert request_of("state", None, NOTHING) == {"do": "state"}
    assert request_of("clear", None, NOTHING | {"id": 3}) == {"do": "clear", "id": 3}
    wanted = {"do": "add", "fault": {"device": "robot", "kind": "mute", "on": "moveLine"}}
    assert request_of("robot", "mute", NOTHING | {"on": "moveLine"}) == wanted


def test_where_no_rig_answers_it_is_said_in_one_line(tmp_path: Path):
    with pytest.raises(FaultRefused, match="no rig answers here") as caught:
        ask_rig(tmp_path / "nobody", {"do": "state"})
    assert caught.value.exit_code == 2
