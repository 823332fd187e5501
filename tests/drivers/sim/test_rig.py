from __future__ import annotations

import asyncio
import json
import tomllib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from brushloop.drivers.arcs.wire import FrameDecoder, encode
from brushloop.drivers.camera import CameraOptions, OpenCvCamera
from brushloop.drivers.devices import Stamp
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim import rig as rig_module
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import HOST, LoopbackRig
from brushloop.drivers.sim.serve import serve


@pytest.fixture
def config(small_view: View) -> SimConfig:
    return SimConfig(rate=20.0, view=small_view)


@pytest.fixture
async def rig(config: SimConfig) -> AsyncIterator[LoopbackRig]:
    async with LoopbackRig(config) as it:
        yield it


async def ask(cabinet: ArcsServer, payload: bytes) -> bytes:
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    writer.write(encode(payload))
    decoder = FrameDecoder()
    while not (replies := decoder.feed(await reader.read(4096))):
        pass
    writer.close()
    await writer.wait_closed()
    return replies[0]


async def test_both_servers_listen_on_loopback_and_nowhere_else(rig: LoopbackRig):
    assert HOST == "127.0.0.1"
    for server in (rig.arcs, rig.camera):
        assert server._server is not None
        assert {s.getsockname() for s in server._server.sockets} == {("127.0.0.1", server.port)}


async def test_the_rigs_toml_names_the_addresses_as_served(rig: LoopbackRig):
    table = tomllib.loads(rig.toml())
    assert (table["robot"]["host"], table["robot"]["port"]) == (HOST, rig.arcs.port)
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
    async with asyncio.timeout(3.0):
        await idle


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (b"hello", -32700),
        (b'{"id":"a","method":"Nonsense"}', -32601),
        (b'{"id":"a","method":"rob1.MotionControl.stopLine"}', -32602),
        (b'{"id":"a","method":"rob1.MotionControl.moveLine","params":{"pose":[1],"a":1,"v":1}}', -32602),
        (b"[]", -32602),
    ],
)
async def test_the_controller_answers_nonsense_with_the_codes_of_json_rpc(
    cabinet: ArcsServer, payload: bytes, code: int
):
    assert json.loads(await ask(cabinet, payload))["error"]["code"] == code


async def test_the_controller_takes_any_login_and_echoes_ids(cabinet: ArcsServer):
    assert await ask(cabinet, b"__login__\nanyone\n00\n0.24.0\n") == b"SUCCEED"
    assert json.loads(await ask(cabinet, b'{"id":"abc","method":"getRobotNames"}'))["id"] == "abc"


async def test_the_controller_hangs_up_on_a_client_that_does_not_speak_sof(cabinet: ArcsServer):
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    writer.write(b"GET / HTTP/1.0\r\n\r\n")
    assert await reader.read() == b""
    writer.close()
    await writer.wait_closed()


async def test_the_motion_queue_belongs_to_the_event_loops_thread(rig: LoopbackRig, monkeypatch: pytest.MonkeyPatch):
    import threading

    seen: set[str] = set()
    advance = rig.world.motion.advance

    def spy(now_s: float) -> None:
        seen.add(threading.current_thread().name)
        advance(now_s)

    monkeypatch.setattr(rig.world.motion, "advance", spy)
    source = f"http://{rig_module.HOST}:{rig.camera.port}/stream.mjpg"
    camera, clock = OpenCvCamera(CameraOptions(source), HostClock()), HostClock()
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
        async with asyncio.timeout(10.0):
            while rig.camera.clients:
                await asyncio.sleep(0.02)
