"""The loopback rig as a whole: its servers, that none is reached from another machine, and what its camera sees."""

from __future__ import annotations

import asyncio
import itertools
import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest

from brushloop.drivers.camera import CameraTable, OpenCvCamera
from brushloop.drivers.devices import Stamp
from brushloop.drivers.force import sri_m8123
from brushloop.drivers.force.simulator import FRAME_S, ForceBoard, SocketcandServer
from brushloop.drivers.force.sri_m8123 import COMMAND_ID, LOOPBACK_CHANNEL, START, ForceTable, SriM8123
from brushloop.drivers.host import HostClock
from brushloop.drivers.loopback import LoopbackServer, NotLoopback
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault, FaultBoard
from brushloop.drivers.sim.rig import HOST, LoopbackRig
from brushloop.drivers.sim.scene import Line, MjpegServer, Scene, board, homography
from brushloop.drivers.sim.serve import ControlServer, serve
from brushloop.drivers.sim.world import World
from tests.waiting import until


@pytest.fixture
def config(small_view: View) -> SimConfig:
    return SimConfig(rate=20.0, view=small_view)


async def test_the_rigs_toml_names_the_addresses_as_served(rig: LoopbackRig):
    table = tomllib.loads(rig.toml())
    assert (table["robot"]["host"], table["robot"]["port"]) == (HOST, rig.arcs.port)
    assert HOST == "127.0.0.1"
    assert table["camera"]["source"] == f"http://{HOST}:{rig.camera.port}/stream.mjpg"


async def test_a_taken_port_leaves_no_half_a_rig(config: SimConfig):
    async with await asyncio.start_server(lambda *_: None, HOST, 0) as other:
        taken = other.sockets[0].getsockname()[1]
        rig = LoopbackRig(SimConfig(view=config.view, camera_port=taken))
        with pytest.raises(OSError, match="in use"):
            await rig.__aenter__()
        with pytest.raises(OSError):  # noqa: PT011 (refused)
            await asyncio.open_connection(HOST, rig.arcs.port)


def test_serving_ends_by_itself_once_nobody_has_called_for_a_while(config: SimConfig, tmp_path: Path):
    target = tmp_path / "rig.toml"
    serve(config, target, idle_exit_s=0.2)
    assert tomllib.loads(target.read_text())["robot"]["host"] == HOST
    assert [p.name for p in tmp_path.iterdir()] == ["rig.toml"]


async def test_a_rig_with_a_client_is_not_idle(rig: LoopbackRig):
    idle = asyncio.create_task(rig.idle(0.3))
    _, writer = await asyncio.open_connection(HOST, rig.arcs.port)
    await asyncio.sleep(0.6)
    assert not idle.done()
    writer.close()
    await writer.wait_closed()
    await idle


async def test_the_motion_queue_belongs_to_the_event_loops_thread(rig: LoopbackRig, monkeypatch: pytest.MonkeyPatch):
    import threading

    seen: set[str] = set()
    advance = rig.world.motion.advance

    def spy(now_s: float) -> None:
        seen.add(threading.current_thread().name)
        advance(now_s)

    monkeypatch.setattr(rig.world.motion, "advance", spy)
    source = f"http://{HOST}:{rig.camera.port}/stream.mjpg"
    camera, clock = OpenCvCamera(CameraTable(kind="opencv", source=source), HostClock()), HostClock()
    await camera.connect()
    await camera.fresh(Stamp(clock.now_ns()))
    await camera.close()
    assert seen == {threading.current_thread().name}


async def test_a_late_camera_notices_that_its_client_has_gone():
    view = View(width_px=320, height_px=240, px_per_mm=0.9, fps=50.0, delay_s=0.05)
    async with LoopbackRig(SimConfig(force_sensor=False, ink_device="none", view=view)) as rig:
        reader, writer = await asyncio.open_connection(HOST, rig.camera.port)
        writer.write(b"GET /stream.mjpg HTTP/1.0\r\n\r\n")
        await reader.readexactly(2000)
        assert rig.camera.clients == 1
        writer.transport.abort()
        await until(lambda: rig.camera.clients == 0, "the server to notice")


ELSEWHERE = ["0.0.0.0", "::", "", "192.168.1.10", "10.0.0.1", "8.8.8.8", "example.org", "localhost", "fe80::1"]


def test_these_are_all_the_servers_there_are():
    def below(kind: type[LoopbackServer]) -> set[type[LoopbackServer]]:
        return {kind, *(b for k in kind.__subclasses__() for b in below(k))}

    ours = {k for k in below(LoopbackServer) if k.__module__.startswith("brushloop.drivers.")} - {LoopbackServer}
    assert ours == {ArcsServer, RtdeServer, MjpegServer, ControlServer, SocketcandServer}
    assert all(k.start is LoopbackServer.start for k in ours), "a server that listens in its own way must refuse too"


@pytest.mark.parametrize("host", ELSEWHERE)
async def test_a_server_refuses_any_address_that_is_not_loopback(host: str):
    server = ArcsServer(World(SimConfig()))
    with pytest.raises(NotLoopback) as caught:
        await server.start(host, 0)
    assert caught.value.host == host
    assert caught.value.exit_code == 2
    assert server._server is None


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2"])
async def test_a_loopback_address_is_served(host: str):
    server = ArcsServer(World(SimConfig()))
    await server.start(host, 0)
    _, writer = await asyncio.open_connection(host, server.port)
    writer.close()
    await writer.wait_closed()
    await server.stop()


async def test_the_frames_of_a_round_are_one_burst_on_a_busy_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    late_s = itertools.count(1000.0, 0.05)
    monkeypatch.setattr(time, "time", lambda: next(late_s))
    server = SocketcandServer(ForceBoard(lambda _: (0.0,) * 6), lambda: 0.0, rate_hz=100.0)
    await server.start("127.0.0.1", 0)
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    command = f"< send {COMMAND_ID:03X} {len(START):x} {' '.join(f'{byte:02X}' for byte in START)} >"
    writer.write(f"< open {LOOPBACK_CHANNEL} >< rawmode >{command}".encode())
    times_s: list[float] = []
    while len(times_s) < 3:
        words = (await reader.readuntil(b">")).decode().split()
        if words[1] == "frame":
            times_s.append(float(words[3]))
    writer.close()
    await writer.wait_closed()
    await server.stop()
    assert [b - a for a, b in itertools.pairwise(times_s)] == pytest.approx([FRAME_S, FRAME_S], abs=1e-6)


async def test_a_force_sensor_that_was_silent_is_heard_again_as_soon_as_the_fault_is_cleared(
    rig: LoopbackRig, monkeypatch: pytest.MonkeyPatch
):
    assert rig.force is not None
    monkeypatch.setattr(sri_m8123, "ROUND_S", 0.5)  # a busy machine pauses within a round
    table = ForceTable(
        kind="sri-m8123", interface="socketcand", channel=LOOPBACK_CHANNEL, host=HOST, port=rig.force.port, stale_ms=2e3
    )
    sensor = SriM8123(table, HostClock())
    await sensor.connect()
    rig.faults.hang(Fault(device=Device.FORCE, kind="silence", count=ALWAYS))
    await until(lambda: rig.faults.hanging[0].struck > 10, "silent rounds")
    assert rig.faults.clear() == 1
    rounds = sensor.stream.rounds
    await until(lambda: sensor.stream.rounds > rounds, "a round")
    await sensor.close()
    bare = FaultBoard(rig.world, [Device.INK])
    with pytest.raises(ValueError, match="device = 'ink': this rig has none"):
        bare.hang(Fault(device=Device.INK, kind="garbage"))


CONFIG = SimConfig(view=View(width_px=1024, height_px=768, px_per_mm=3.125))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(World(CONFIG))


def pixel(x_mm: float, y_mm: float) -> tuple[int, int]:
    """(column, row) of a point of the paper frame."""
    u, v, w = homography(CONFIG.view) @ np.array([x_mm, y_mm, 1.0])
    return round(u / w), round(v / w)


def gray_at(image: np.ndarray, x_mm: float, y_mm: float) -> float:
    column, row = pixel(x_mm, y_mm)
    return float(image[row - 3 : row + 4, column - 3 : column + 4].mean())


@pytest.mark.parametrize("view", [CONFIG.view, View(k1=-0.08)], ids=["a lens without distortion", "with"])
def test_corners_of_the_board_lie_where_the_optics_say(view: View):
    table, scene = CONFIG.table, Scene(World(SimConfig(view=view)))
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board(table)).detectBoard(scene.render())
    on_board = np.asarray(board(table).getChessboardCorners())[ids.ravel(), :2]
    left, bottom = table.board_origin_mm
    height_mm = table.board_squares[1] * table.board_square_mm
    paper_mm = np.column_stack([left + on_board[:, 0], bottom + height_mm - on_board[:, 1]]).astype(np.float64)
    off_px = corners.reshape(-1, 2) - scene.optics.image_of(paper_mm)
    assert len(ids) > 100
    assert np.quantile(np.linalg.norm(off_px, axis=1), 0.95) < 0.8
    # Blur rounds the corners of black squares, by turns to either side; the mean shows a wrong half pixel.
    assert np.abs(np.mean(off_px, axis=0)).max() < 0.1


def test_noise_is_new_in_every_frame(scene: Scene):
    assert not np.array_equal(scene.render(), scene.render())


def test_ink_shows_in_the_very_next_frame():
    world = World(CONFIG)
    scene = Scene(world)
    before = gray_at(scene.render(), 60.0, 60.0)
    world.paper.density = np.ones_like(world.paper.density)
    world.version += 1
    assert gray_at(scene.render(), 60.0, 60.0) < 0.3 * before


def test_the_arm_hides_what_is_under_it():
    table = CONFIG.table
    assert table.yaw_deg == 90.0
    home = (table.origin_mm[0] - 74.0, table.origin_mm[1] + 82.0, 260.0)  # over (82, 74) of the sheet
    image = Scene(World(replace(CONFIG, home_mm=home))).render()
    assert gray_at(image, 82.0, 74.0) == pytest.approx(70.0, abs=3.0)


def test_a_frame_rendered_for_a_known_tool_leaves_the_world_alone(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    tool = scene.tool()

    def nobody_may_ask(_: World) -> None:
        raise AssertionError("the world was moved on from the rendering thread")

    monkeypatch.setattr(World, "tool", nobody_may_ask)
    scene.render(tool)


class Loop:
    """A clock that stands still, and what is due on it."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.due_s: list[float] = []

    def time(self) -> float:
        return self.now_s

    def call_at(self, when_s: float, _call: Callable[..., None], _data: bytes) -> None:
        self.due_s.append(when_s)


class Open:
    """A connection; its client has taken everything once `taken` is set."""

    def __init__(self) -> None:
        self.taken = asyncio.Event()
        self.taken.set()

    def is_closing(self) -> bool:
        return False

    async def drain(self) -> None:
        await self.taken.wait()


async def test_the_time_to_draw_a_picture_is_a_part_of_its_delay_and_no_picture_overtakes_another() -> None:
    loop, line = Loop(), Line(View(delay_s=0.3, delay_jitter_s=0.0), cast("asyncio.StreamWriter", Open()))
    line._loop = cast("asyncio.AbstractEventLoop", loop)
    line._last_s = loop.now_s
    for drawn_s in (0.05, 0.0, 2.0, 0.0):
        exposed_s = loop.now_s
        loop.now_s += drawn_s
        await line.send(b"picture", exposed_s)
    assert loop.due_s == pytest.approx([100.3, 100.35, 100.35, 102.35], abs=1e-3)
    assert loop.due_s == sorted(set(loop.due_s))


async def test_a_client_that_reads_too_slowly_is_sent_no_further_picture_until_it_has_taken_the_earlier_ones() -> None:
    client = Open()
    client.taken.clear()
    line = Line(View(delay_s=0.3), cast("asyncio.StreamWriter", client))
    sending = asyncio.create_task(line.send(b"picture", 0.0))
    await asyncio.sleep(0)
    assert not sending.done()
    client.taken.set()
    await sending
