"""The loopback rig as a whole: its servers, that none is reached from another machine, its control, faults and camera.

A lab that is drawn from a seed is such a rig too.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import signal
import stat
import threading
import time
import tomllib
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import cv2
import numpy as np
import pytest

from brushloop.drivers.camera import CameraTable
from brushloop.drivers.camera.source import Capture
from brushloop.drivers.force.simulator import FRAME_S, ForceBoard, SocketcandServer
from brushloop.drivers.force.sri_m8123 import COMMAND_ID, LOOPBACK_CHANNEL, START
from brushloop.drivers.ink.simulator import InstrumentServer
from brushloop.drivers.loopback import LoopbackServer, RigRefused
from brushloop.drivers.loopback import ask as ask_rig
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault, FaultBoard, Phase, fault_of
from brushloop.drivers.sim.lab import UnknownLab
from brushloop.drivers.sim.lab_facts import draw, in_picture
from brushloop.drivers.sim.rig import HOST, ControlServer, LoopbackRig, serve
from brushloop.drivers.sim.scene import MjpegServer, Scene, board
from brushloop.drivers.sim.world import World
from tests.command import brushloop
from tests.rigs import BARE, BENT_VIEW, SMALL_TABLE
from tests.waiting import until

SMALL = replace(BARE, table=SMALL_TABLE)


@pytest.fixture
async def rig() -> AsyncIterator[LoopbackRig]:
    """One without ink device and force sensor, fast."""
    async with LoopbackRig(SMALL) as it:
        yield it


async def test_a_taken_port_leaves_no_half_a_rig():
    async with await asyncio.start_server(lambda *_: None, HOST, 0) as other:
        taken = other.sockets[0].getsockname()[1]
        rig = LoopbackRig(SMALL, ports={"camera": taken})
        with pytest.raises(OSError, match="in use"):
            await rig.__aenter__()
        with pytest.raises(OSError):  # noqa: PT011 (refused)
            await asyncio.open_connection(HOST, rig.arcs.port)


async def test_serving_ends_by_itself_and_leaves_a_rig_toml_unless_another_file_stands_there(tmp_path: Path):
    rig, target, lines = LoopbackRig(SMALL), tmp_path / "rig.toml", list[str]()
    sheet = rig.world.paper
    serving = asyncio.create_task(serve(rig, lines.append, write_rig=target, idle_exit_s=0.2))
    await until(target.exists, "the rig")
    signal.raise_signal(signal.SIGUSR1)
    await serving
    assert rig.world.paper is not sheet
    assert tomllib.loads(target.read_text())["robot"]["host"] == HOST == "127.0.0.1"
    assert [p.name for p in tmp_path.iterdir()] == ["rig.toml"]
    assert str(target) in lines[0]
    target.write_text("name = 'our rig'")
    with pytest.raises(RigRefused, match="was not written by a loopback rig"):
        await serve(LoopbackRig(SMALL), lines.append, write_rig=target)
    (tmp_path / "other.toml.part").mkdir()
    with pytest.raises(RigRefused, match=r"other\.toml: cannot be written: Is a directory"):
        await serve(LoopbackRig(SMALL), lines.append, write_rig=tmp_path / "other.toml")


async def test_a_rig_with_a_client_is_not_idle(rig: LoopbackRig):
    _, writer = await asyncio.open_connection(HOST, rig.arcs.port)
    await until(lambda: rig.arcs.clients == 1, "the server to notice")
    idle = asyncio.create_task(rig.idle(0.3))
    await asyncio.sleep(0.6)
    assert not idle.done()
    writer.close()
    await writer.wait_closed()
    await idle


async def pictures_of(rig: LoopbackRig) -> Capture:
    """Its camera's stream, which has sent a picture."""
    source = tomllib.loads(rig.toml())["camera"]["source"]
    return await asyncio.to_thread(Capture, CameraTable(kind="opencv", source=source))


async def test_the_motion_queue_belongs_to_the_event_loops_thread(rig: LoopbackRig, monkeypatch: pytest.MonkeyPatch):
    seen: set[str] = set()
    motion, advance = rig.world.motion, rig.world.motion.advance
    monkeypatch.setattr(motion, "advance", lambda now_s: (seen.add(threading.current_thread().name), advance(now_s)))
    (await pictures_of(rig)).close()
    assert seen == {threading.current_thread().name}


def test_these_are_all_the_servers_there_are():
    def below(kind: type[LoopbackServer]) -> set[type[LoopbackServer]]:
        return {kind, *(b for k in kind.__subclasses__() for b in below(k))}

    ours = {k for k in below(LoopbackServer) if k.__module__.startswith("brushloop.drivers.")} - {LoopbackServer}
    assert ours == {ArcsServer, RtdeServer, MjpegServer, ControlServer, SocketcandServer, InstrumentServer}
    assert all(k.start is LoopbackServer.start for k in ours), "a server that listens in its own way must refuse too"


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "", "192.168.1.10", "10.0.0.1", "8.8.8.8", "example.org", "localhost", "fe80::1"]
)
async def test_a_server_refuses_any_address_that_is_not_loopback(host: str):
    server = LoopbackServer()
    with pytest.raises(ValueError, match=re.escape(repr(host))):
        await server.start(host, 0)
    assert server.port == 0
    await server.start("127.0.0.2", 0)
    await server.stop()


async def test_the_frames_of_a_round_are_one_burst_on_a_busy_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    late_s = itertools.count(1000.0, 0.05)
    monkeypatch.setattr(time, "time", lambda: next(late_s))
    server = SocketcandServer(ForceBoard(lambda: (0.0,) * 6), rate_hz=100.0)
    await server.start("127.0.0.1", 0)
    wire = {"interface": "socketcand", "channel": LOOPBACK_CHANNEL, "host": HOST, "port": server.port}
    bus = await asyncio.to_thread(can.Bus, ignore_config=True, **wire)
    bus.send(can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, data=START))
    frames = [await asyncio.to_thread(bus.recv) for _ in range(3)]
    await asyncio.to_thread(bus.shutdown)
    await server.stop()
    assert [b.timestamp - a.timestamp for a, b in itertools.pairwise(frames)] == pytest.approx(
        [FRAME_S, FRAME_S], abs=1e-6
    )


async def test_only_its_owner_can_open_it_and_no_other_file_or_rig_is_pushed_aside(rig: LoopbackRig, tmp_path: Path):
    path = tmp_path / "control"

    async def refused(at: Path, words: str) -> None:
        with pytest.raises(RigRefused, match=words):
            async with ControlServer(rig, at):
                pass

    dead = path.with_name("dead")
    async with ControlServer(rig, path):
        mode = path.stat().st_mode
        assert stat.S_ISSOCK(mode)
        assert stat.S_IMODE(mode) == 0o600
        await refused(path, "another rig listens here")
        path.rename(dead)
    async with ControlServer(rig, dead):  # replaced
        pass
    path.write_text("mine")
    await refused(path, "already in use")
    assert path.read_text() == "mine"
    await refused(path.with_name("x" * 120), "too long")  # the system would cut it
    await refused(path / "no", "cannot listen here")


async def test_a_person_breaks_the_rig_sees_its_state_and_mends_it(rig: LoopbackRig, tmp_path: Path):
    path = tmp_path / "control"

    async def fault(*words: str) -> Any:
        return await asyncio.to_thread(brushloop, "sim", "fault", path, *words)

    async def ask(do: str, **request: object) -> dict[str, Any]:
        return await asyncio.to_thread(ask_rig, path, {"do": do, **request})

    async with ControlServer(rig, path):
        before = await ask("state")
        assert (before["phase"], before["moving"], before["presses"], before["ink_load"]) == ("parked", False, 0, 0.0)
        assert (before["robot_mode"], before["safety_mode"], before["faults"]) == ("PowerOff", "Normal", 0)
        assert before["tip_mm"] == [250.0, -230.0, 260.0]
        added = await fault("robot", "mute", "--on", "moveLine", "--count", "3")
        assert json.loads(added.stdout) == {"id": 1}
        hung = {"device": "robot", "kind": "mute", "on": "moveLine", "count": 3}
        assert json.loads((await fault("list")).stdout) == {"hanging": [{"id": 1, "fault": hung, "struck": 0}]}
        assert (await fault("robot", "loud")).stderr.startswith("brushloop: kind = 'loud' is not one of robot's")
        assert await ask("clear", id=7) == {"taken": 0}
        assert json.loads((await fault("clear")).stdout) == {"taken": 1}
        await fault("robot", "emergency-stop")
        while (await ask("state"))["safety_mode"] != "RobotEmergencyStop":
            await asyncio.sleep(0.005)
        assert await ask("release") == {"was": "RobotEmergencyStop"}
        assert (await ask("state"))["safety_mode"] == "Normal"
    assert not path.exists()
    assert "control: no rig answers here" in (await fault("clear")).stderr


def test_corners_of_the_board_lie_where_the_optics_say_through_a_lens_that_distorts():
    config = SimConfig(view=BENT_VIEW)
    table, world = config.table, World(config)
    scene = Scene(world)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board(table)).detectBoard(scene.render(world.tool()))
    on_board = np.array(board(table).getChessboardCorners(), np.float64)[ids.ravel().astype(np.intp), :2]
    left, bottom = table.board_origin_mm
    height_mm = table.board_squares[1] * table.board_square_mm
    paper_mm = np.column_stack([left + on_board[:, 0], bottom + height_mm - on_board[:, 1]]).astype(np.float64)
    off_px = corners.reshape(-1, 2) - scene.optics.image_of(paper_mm)
    assert len(ids) > 100
    assert np.quantile(np.linalg.norm(off_px, axis=1), 0.95) < 0.8
    # Blur rounds the corners of black squares, by turns to either side; the mean shows a wrong half pixel.
    assert np.abs(np.mean(off_px, axis=0)).max() < 0.1


async def test_no_late_picture_overtakes_another_and_the_server_notices_that_its_client_has_gone():
    view = View(width_px=320, height_px=240, px_per_mm=0.9, fps=50.0, delay_s=0.05, delay_jitter_s=0.2)
    async with LoopbackRig(replace(SMALL, view=view)) as rig:
        rig.faults.hang(Fault(device=Device.CAMERA, kind="frozen", count=ALWAYS))  # numbers its pictures
        stream = await pictures_of(rig)
        jpegs = [await asyncio.to_thread(stream.read) or b"" for _ in range(20)]
        numbers = [int(jpeg[6 : jpeg.index(b"\xff", 6)]) for jpeg in jpegs]  # of the comment
        assert numbers == sorted(numbers)
        assert rig.camera.clients == 1
        stream.close()
        await until(lambda: rig.camera.clients == 0, "the server to notice")


# ---------------------------------------------------------------- when a fault begins, and what it strikes

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
        ({"kind": "emergency-stop", "nth": 2}, "has no effect"),
        ({"a\nb\x1b[31m": 1}, "Extra inputs are not permitted"),
    ],
)
def test_what_cannot_be_used_is_refused_with_one_printable_line(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        fault_of({"device": "robot", "kind": "mute"} | fields)
    assert str(caught.value).isprintable()


# ---------------------------------------------------------------- a lab drawn from a seed, and its person


def lab_of(seed: int) -> UnknownLab:
    """A lab that does not serve: hand, arm and scene are there, the sockets are not."""
    return UnknownLab(seed, None, rate=500.0, picture_px=(640, 480))


def test_a_seed_is_one_lab_whose_arm_parks_outside_the_picture():
    for seed in range(4):
        facts = draw(seed)
        assert facts == draw(seed) != draw(seed + 1)
        assert not in_picture(facts.config, [facts.park_mm])


def test_the_labels_tell_where_to_connect_and_neither_they_nor_the_cabinet_what_has_to_be_measured():
    lab = lab_of(4)
    words = " ".join(lab.labels())
    assert lab.host in words
    for hidden in (lab.facts.config.tool_mm, lab.facts.config.table.yaw_deg, lab.facts.pin_mm[0]):
        assert f"{hidden:.1f}" not in words
    assert lab.arcs.cabinet.tcp_offset == list(lab.facts.cabinet_tcp), "what somebody left in it"


async def test_a_person_at_the_command_line_guides_the_arm_and_hears_what_cannot_be_done(tmp_path: Path):
    lab, socket = lab_of(4), tmp_path / "lab.sock"
    said = {
        ("bring", "board-corner", "--corner", "lower left"): "The tip is at the board-corner, lower left.\n",
        ("dance",): "brushloop: act = 'dance' is not one of bring",
        ("bring", "moon"): "brushloop: to = 'moon' is not one of pin",
        ("bring", "board-corner", "--corner", "middle"): "brushloop: corner = 'middle' is not one of lower left",
        ("measure", "weight"): "brushloop: to = 'weight' is not one of square",
    }
    async with ControlServer(lab, socket):
        for words, expected in said.items():
            ran = await asyncio.to_thread(brushloop, "sim", "hand", socket, *words)
            assert (ran.stdout + ran.stderr).startswith(expected)
