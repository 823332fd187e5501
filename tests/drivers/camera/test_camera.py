from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from brushloop.drivers.camera import CameraOptions, OpenCvCamera, opencv
from brushloop.drivers.devices import Camera, Frame, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.mjpeg_server import MjpegServer
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.scene import Scene, read_strip
from brushloop.drivers.sim.world import World
from tests.waiting import PATIENCE_S

CLOCK = HostClock()


@pytest.fixture
async def stream(small_view: View) -> AsyncIterator[MjpegServer]:
    server = MjpegServer(Scene(World(SimConfig(view=small_view))), replace(small_view, fps=15.0, jpeg_quality=90))
    await server.start(HOST, 0)
    yield server
    await server.stop()


def camera_at(port: int, timeout_s: float = 3.0) -> OpenCvCamera:
    return OpenCvCamera(CameraOptions(f"http://{HOST}:{port}/stream.mjpg", timeout_s=timeout_s), CLOCK)


@pytest.fixture
async def camera(stream: MjpegServer) -> AsyncIterator[OpenCvCamera]:
    it = camera_at(stream.port)
    await it.connect()
    yield it
    await it.close()


def grabbers() -> int:
    return sum(t.name == "camera grabber" for t in threading.enumerate())


async def test_connecting_waits_for_the_first_frame_and_reports_its_size(stream: MjpegServer):
    camera = camera_at(stream.port)
    assert isinstance(camera, Camera)
    identity = await camera.connect()
    assert "640x480" in identity.model
    assert identity.simulated  # the loopback camera says so itself
    await camera.close()


async def test_after_two_idle_seconds_a_fresh_frame_is_no_older_than_asked(camera: OpenCvCamera):
    await asyncio.sleep(2.0)
    asked_ns = CLOCK.now_ns()
    frame = await camera.fresh(Stamp(asked_ns))
    assert read_strip(frame.image) >= asked_ns
    assert frame.exposed_after_ns >= asked_ns


async def test_no_frame_is_ever_older_than_asked_right_after_connecting_and_later(stream: MjpegServer):
    camera = camera_at(stream.port)
    await camera.connect()
    for _ in range(4):
        asked_ns = CLOCK.now_ns()
        assert read_strip((await camera.fresh(Stamp(asked_ns))).image) >= asked_ns
    await camera.close()


async def test_the_first_frame_counts_from_when_the_camera_was_opened(stream: MjpegServer):
    camera = camera_at(stream.port)
    opened_ns = CLOCK.now_ns()
    await camera.connect()
    connected_ns = CLOCK.now_ns()
    first = await camera.fresh(Stamp(0))
    if first.stamp.seq == 0:
        assert opened_ns <= first.exposed_after_ns + 250_000_000 <= connected_ns
        assert first.exposed_after_ns <= read_strip(first.image)
    await camera.close()


async def test_a_stream_that_ends_is_opened_again_and_both_are_reported(small_view: View):
    notices: list[str] = []
    scene = Scene(World(SimConfig(view=small_view)))
    first = MjpegServer(scene, replace(small_view, fps=15.0, jpeg_quality=90))
    await first.start(HOST, 0)
    url = f"http://{HOST}:{first.port}/stream.mjpg"
    camera = OpenCvCamera(CameraOptions(url, timeout_s=10.0), CLOCK, notices.append)
    await camera.connect()
    await first.stop()
    second = MjpegServer(scene, replace(small_view, fps=15.0, jpeg_quality=90))
    await second.start(HOST, first.port)
    asked_ns = CLOCK.now_ns()
    frame = await camera.fresh(Stamp(asked_ns))
    assert read_strip(frame.image) >= asked_ns
    assert notices[0] == "camera: the stream ended and is opened again"
    assert notices[1].startswith("camera is back after")
    await camera.close()
    await second.stop()


class Stuttering:
    """A source that is dark for two seconds, then shows one frame, ten times; then shows frames for a minute, and is
    dark again. A frame comes every tenth of a second of its own clock."""

    live, independent, simulated = True, False, True
    settings: ClassVar[dict[str, float]] = {}

    def __init__(self) -> None:
        self.t_ns, self.over = 0, threading.Event()
        self._dark = iter(([False] + [True] * 20) * 10 + [False] * 600 + [True] * 20)

    def now_ns(self) -> int:
        return self.t_ns

    def read(self) -> Any:
        dark = next(self._dark, None)
        if dark is None:
            self.over.set()
            time.sleep(0.01)
        self.t_ns += 100_000_000
        noise = np.random.default_rng(self.t_ns).integers(100, 200, (48, 64), np.uint8)
        return np.zeros_like(noise) if dark else noise

    def release(self) -> None:
        pass


async def test_frames_that_are_skipped_again_and_again_are_reported_once(monkeypatch: pytest.MonkeyPatch):
    source, notices = Stuttering(), list[str]()
    monkeypatch.setattr(opencv, "open_source", lambda _options: source)
    camera = OpenCvCamera(CameraOptions("scripted"), source, notices.append)
    await camera.connect()
    await asyncio.to_thread(source.over.wait, PATIENCE_S)
    await camera.close()
    assert len(notices) == 2, notices


async def test_a_stream_that_stays_away_is_a_timeout_that_says_so(stream: MjpegServer):
    camera = camera_at(stream.port, timeout_s=1.0)
    await camera.connect()
    await stream.stop()
    with pytest.raises(DeviceTimeout, match="the stream ended and is opened again"):
        await camera.fresh(Stamp(CLOCK.now_ns() + 10**9))
    await camera.close()


async def test_closing_never_hands_an_old_frame_to_whoever_still_waits(camera: OpenCvCamera):
    async def wait() -> Frame:
        return await camera.fresh(Stamp(CLOCK.now_ns() + 60 * 10**9))

    waiting = asyncio.create_task(wait())
    await asyncio.sleep(0.1)
    await camera.close()
    with pytest.raises(ConnectionLost, match="closed while waiting"):
        await waiting


async def test_a_server_that_says_nothing_is_given_up_within_the_timeout():
    over = asyncio.Event()

    async def say_nothing(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await over.wait()
        writer.close()

    async with await asyncio.start_server(say_nothing, HOST, 0) as mute:
        camera = camera_at(mute.sockets[0].getsockname()[1], timeout_s=0.5)
        with pytest.raises(DeviceError):
            await camera.connect()
        assert grabbers() == 0
        over.set()


class OneFrame:
    """A source that gives one frame of this brightness, and a second one, 40 levels lighter, once it is let go."""

    live, independent, simulated = True, False, True

    def __init__(self, level: int) -> None:
        self._level = level
        self.settings: dict[str, float] = {}
        self._reads = 0
        self.let_go, self.released = threading.Event(), threading.Event()

    def read(self) -> np.ndarray | None:
        self._reads += 1
        if self._reads > 1:
            self.let_go.wait()
        noise = np.random.default_rng(self._reads).integers(0, 20, (48, 64), np.uint8)
        return noise + np.uint8(self._level + 40 * (self._reads - 1)) if self._reads < 3 else None

    def release(self) -> None:
        self.released.set()


async def test_a_read_that_hangs_beyond_the_end_of_its_connection_gives_the_next_one_no_frame(
    monkeypatch: pytest.MonkeyPatch,
):
    before, after = OneFrame(50), OneFrame(150)
    sources = iter([before, after])
    monkeypatch.setattr(opencv, "open_source", lambda _options: next(sources))
    monkeypatch.setattr(opencv, "JOIN_S", 0.01, raising=False)
    camera = OpenCvCamera(CameraOptions("rtsp://camera"), CLOCK)
    await camera.connect()
    await camera.close()
    await camera.connect()
    before.let_go.set()
    await asyncio.to_thread(before.released.wait)
    assert (await camera.fresh(Stamp(0))).image.mean() > 140
    after.let_go.set()
    await camera.close()
