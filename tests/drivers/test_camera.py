"""The camera: no frame older than asked, frames that must not be believed are passed over, settings are locked."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brushloop.drivers import camera as camera_module
from brushloop.drivers.camera import Backlog, CameraTable, FrameFault, Locked, OpenCvCamera, looked_at
from brushloop.drivers.camera.source import JpegStream, is_repeated, open_source
from brushloop.drivers.devices import Pose, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.faults import ALWAYS, Fault, FaultBoard
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.scene import MjpegServer, Scene, renumbered, torn
from brushloop.drivers.sim.world import World
from tests.waiting import until

CLOCK = HostClock()


BITS, BLOCK_PX = 64, 8


class StampedScene(Scene):
    """Its pictures have the time from which they are in their top rows: 64 black or white blocks."""

    at_ns = 0

    def tool(self) -> Pose:
        self.at_ns = time.time_ns()
        return super().tool()

    def render(self, tool: Pose | None = None) -> NDArray[np.uint8]:
        frame = super().render(tool).copy()
        bits = [self.at_ns >> place & 1 for place in range(BITS)]
        frame[: 2 * BLOCK_PX, : BITS * BLOCK_PX] = np.repeat(255 * np.array(bits, np.uint8), BLOCK_PX)
        return frame


def stamp_of(frame: NDArray[np.uint8]) -> int:
    """The time in a picture, also after JPEG compression."""
    row = frame[BLOCK_PX // 2 : BLOCK_PX * 3 // 2, : BITS * BLOCK_PX].mean(axis=0)
    blocks = row.reshape(BITS, BLOCK_PX)[:, 2:-2].mean(axis=1) > 127
    return sum(1 << place for place, bit in enumerate(blocks) if bit)


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
def faults(small_view: View) -> FaultBoard:
    return FaultBoard(World(SimConfig(view=small_view)))


@pytest.fixture
async def stream(small_view: View, faults: FaultBoard) -> AsyncIterator[MjpegServer]:
    server = MjpegServer(StampedScene(faults._world), replace(small_view, fps=15.0), faults)
    await server.start(HOST, 0)
    yield server
    await server.stop()


def camera_at(source: str, on_notice: Callable[[str], None] = lambda _text: None, **more: Any) -> OpenCvCamera:
    table = {"kind": "opencv", "source": source, "timeout_s": 60.0, **more}
    return OpenCvCamera(CameraTable.model_validate(table), CLOCK, on_notice)


def url(server: MjpegServer) -> str:
    return f"http://{HOST}:{server.port}/stream.mjpg"


@pytest.fixture
async def camera(stream: MjpegServer, notices: list[str]) -> AsyncIterator[OpenCvCamera]:
    # A busy machine takes its time to draw a picture.
    camera = camera_at(url(stream), notices.append, latency_ms=2000.0)
    await camera.connect()
    yield camera
    await camera.close()


async def seen_after(camera: OpenCvCamera, after_ns: int) -> int:
    """When the frame that the driver hands over was really rendered."""
    return stamp_of((await camera.fresh(Stamp(after_ns))).image)


def impatient(camera: OpenCvCamera) -> None:
    """From now on give up soon."""
    assert camera._grabber is not None
    camera._grabber._table = camera._grabber._table.model_copy(update={"timeout_s": 1.0})


async def test_connecting_reports_the_size_and_the_first_frame_counts_from_when_the_camera_was_opened(
    stream: MjpegServer,
):
    camera = camera_at(url(stream))
    opened_ns = CLOCK.now_ns()
    identity = await camera.connect()
    connected_ns = CLOCK.now_ns()
    assert "640x480" in identity.model
    assert identity.simulated  # the loopback camera says so itself
    first = await camera.fresh(Stamp(0))
    if first.stamp.seq == 0:
        assert opened_ns <= first.exposed_after_ns + 250_000_000 <= connected_ns
        assert first.exposed_after_ns <= stamp_of(first.image)
    await camera.close()


async def test_no_frame_is_ever_older_than_asked_right_after_connecting_and_after_a_pause(camera: OpenCvCamera):
    for pause_s in (0.0, 0.0, 2.0):
        await asyncio.sleep(pause_s)
        asked_ns = CLOCK.now_ns()
        frame = await camera.fresh(Stamp(asked_ns))
        assert stamp_of(frame.image) >= asked_ns
        assert frame.exposed_after_ns >= asked_ns


async def test_a_stream_that_ends_is_opened_again_and_both_are_reported(
    stream: MjpegServer, camera: OpenCvCamera, notices: list[str], small_view: View
):
    await stream.stop()
    await until(lambda: notices, "the end of the stream")
    impatient(camera)
    with pytest.raises(DeviceTimeout, match="the stream ended and is opened again"):
        await camera.fresh(Stamp(CLOCK.now_ns()))
    second = MjpegServer(stream._scene, replace(small_view, fps=15.0))
    await second.start(HOST, stream.port)
    await until(lambda: len(notices) == 2, "the stream to be opened")
    asked_ns = CLOCK.now_ns()
    camera._grabber._table = camera._table  # type: ignore[union-attr]
    assert await seen_after(camera, asked_ns) >= asked_ns
    assert notices[0] == "camera: the stream ended and is opened again"
    assert notices[1].startswith("camera is back after")
    await camera.close()
    await second.stop()


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("black", r"\(The picture is black: lens covered or light off\? frames skipped: .*\d+ black"),
        ("frozen", r"\(frames skipped: .*\d+ frozen"),
        ("torn", r"\(frames skipped: .*\d+ torn"),
    ],
)
async def test_frames_that_are_no_picture_are_a_timeout_that_names_them_and_then_it_goes_on(
    stream: MjpegServer, faults: FaultBoard, kind: str, words: str
):
    camera = camera_at(url(stream), latency_ms=0.0)
    await camera.connect()
    ident = faults.hang(Fault.model_validate({"device": "camera", "kind": kind, "count": ALWAYS}))
    impatient(camera)
    said = ""
    while kind not in said:
        try:
            await camera.fresh(Stamp(CLOCK.now_ns()))
        except DeviceTimeout as error:
            said = str(error)
    assert re.search(words, said)
    faults.take(ident)
    camera._grabber._table = camera._table  # type: ignore[union-attr]
    asked_ns = CLOCK.now_ns()
    assert (await camera.fresh(Stamp(asked_ns))).exposed_after_ns >= asked_ns
    await camera.close()


async def test_a_picture_that_comes_again_is_not_taken_for_new_even_once(faults: FaultBoard, camera: OpenCvCamera):
    for _ in range(2):
        faults.hang(Fault.model_validate({"device": "camera", "kind": "frozen", "count": 4}))
        asked_ns = CLOCK.now_ns()
        assert await seen_after(camera, asked_ns) >= asked_ns


async def test_closing_never_hands_an_old_frame_to_whoever_still_waits(camera: OpenCvCamera):
    waiting = asyncio.create_task(camera.fresh(Stamp(CLOCK.now_ns() + 3600 * 10**9)))
    await asyncio.sleep(0.1)
    await camera.close()
    with pytest.raises(ConnectionLost, match="closed while waiting"):
        await waiting


async def test_a_server_that_says_nothing_is_given_up():
    over = asyncio.Event()

    async def say_nothing(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await over.wait()
        writer.close()

    async with await asyncio.start_server(say_nothing, HOST, 0) as mute:
        with pytest.raises(DeviceError):
            await camera_at(f"http://{HOST}:{mute.sockets[0].getsockname()[1]}/", timeout_s=0.5).connect()
        assert not [thread for thread in threading.enumerate() if thread.name == "camera grabber"]
        over.set()


class OneFrame:
    """A source that gives one frame of this brightness, and a second one, 40 levels lighter, once it is let go."""

    live, simulated = True, True
    settings: ClassVar[dict[str, float]] = {}

    def __init__(self, level: int) -> None:
        self._level = level
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
    monkeypatch.setattr(camera_module, "open_source", lambda _table: next(sources))
    monkeypatch.setattr(camera_module, "JOIN_S", 0.01)
    camera = camera_at("rtsp://camera")
    await camera.connect()
    await camera.close()
    await camera.connect()
    before.let_go.set()
    await asyncio.to_thread(before.released.wait)
    assert (await camera.fresh(Stamp(0))).image.mean() > 140
    after.let_go.set()
    await camera.close()


# ---------------------------------------------------------------- one frame after the other

RNG = np.random.default_rng(0)


def page(level: float = 220.0, noise: float = 2.0) -> np.ndarray:
    return np.clip(RNG.normal(level, noise, (480, 640)), 0, 255).astype(np.uint8)


def inked() -> np.ndarray:
    image = page()
    image[200:260, 100:500] = 20
    return image


def cut(fill: int) -> np.ndarray:
    image = page()
    image[400:] = fill
    return image


@pytest.mark.parametrize(
    ("image", "fault"),
    [
        (inked(), None),
        (page(8.0, 3.0), FrameFault.BLACK),
        (page(300.0), FrameFault.SATURATED),
        (page(245.0), None),
        (cut(0), FrameFault.TORN),
        (cut(200), FrameFault.TORN),
    ],
    ids=["ink", "lens cap", "overexposed", "white paper", "black end", "gray end"],
)
def test_one_frame_is_judged_by_what_it_shows(image: np.ndarray, fault: FrameFault | None) -> None:
    seen = looked_at(image)
    assert seen is image if fault is None else seen is fault


def test_a_jpeg_is_the_same_picture_in_gray_and_one_that_is_cut_off_is_torn(capfd: pytest.CaptureFixture[str]) -> None:
    colours = np.dstack([page(200.0), page(100.0), page(150.0)])
    jpeg = cv2.imencode(".jpg", colours)[1].tobytes()
    seen = looked_at(jpeg)
    assert isinstance(seen, np.ndarray)
    assert np.abs(seen.astype(float) - cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)).mean() < 3.0
    for size in (1, 200, len(jpeg) // 2, len(jpeg) - 2):
        assert looked_at(jpeg[:size]) is FrameFault.TORN
    assert looked_at(torn(jpeg)) is FrameFault.TORN
    assert not capfd.readouterr().err, "a decoder that writes on the terminal would spoil the screen"


def test_a_picture_is_the_one_before_where_only_what_a_jpeg_says_about_itself_has_changed() -> None:
    jpeg, other = (cv2.imencode(".jpg", page())[1].tobytes() for _ in range(2))
    assert is_repeated(renumbered(jpeg, 7), jpeg)
    assert not is_repeated(other, jpeg)
    assert not is_repeated(jpeg, None)
    image = page()
    assert is_repeated(image.copy(), image)
    assert not is_repeated(page(), image)


MS = 1_000_000
ARRIVALS: dict[str, tuple[int, list[int], list[int]]] = {
    "a backlog after a pause": (250, [*range(0, 600, 100), 2500, 2501, 2502, 2602, 2702], [6, 7, 8]),
    "slow at first, then fast": (250, [*range(0, 2000, 500), *range(3500, 4700, 100)], [4, 5, 6, 7, 8]),
    "a burst at first": (60, [*range(0, 25, 5), *range(100, 3300, 80)], [5, 6, 7, 8, 9]),
}


@pytest.mark.parametrize(("latency_ms", "arrivals_ms", "late"), ARRIVALS.values(), ids=ARRIVALS.keys())
def test_frames_that_waited_in_a_buffer_are_late(latency_ms: int, arrivals_ms: list[int], late: list[int]) -> None:
    backlog = Backlog(latency_ms * MS)
    assert [k for k, at_ms in enumerate(arrivals_ms) if backlog.is_late(at_ms * MS)] == late


# ---------------------------------------------------------------- recordings and settings


@asynccontextmanager
async def serving(answer: bytes) -> AsyncIterator[str]:
    """The address of a server that gives every client the same answer."""

    async def give(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(answer)
        writer.close()

    async with await asyncio.start_server(give, HOST, 0) as server:
        yield f"http://{HOST}:{server.sockets[0].getsockname()[1]}/"


MULTIPART = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=b\r\n\r\n"
JPEG = cv2.imencode(".jpg", page())[1].tobytes()
PART = b"--b\r\nContent-Type: image/jpeg\r\ncontent-length: %d\r\n\r\n" % len(JPEG) + JPEG + b"\r\n"


@pytest.mark.parametrize(
    ("answer", "jpegs"),
    [(MULTIPART + 2 * PART, 2), (MULTIPART + PART + PART[:-99], 1), (MULTIPART + PART + b"\xff" * 99_999, 1)],
    ids=["ends", "cut off", "garbage"],
)
async def test_pushed_jpegs_are_handed_over_as_they_came_until_the_stream_ends(answer: bytes, jpegs: int):
    async with serving(answer) as address:
        source = await asyncio.to_thread(open_source, CameraTable(kind="opencv", source=address))
        assert isinstance(source, JpegStream)
        assert not source.simulated
        for _ in range(jpegs):
            assert await asyncio.to_thread(source.read) == JPEG
        assert await asyncio.to_thread(source.read) is None
        source.release()


async def test_a_stream_without_lengths_is_read_by_ffmpeg():
    part = b"--b\r\nContent-Type: image/jpeg\r\n\r\n" + JPEG + b"\r\n"
    async with serving(MULTIPART + 5 * part) as address:
        camera = camera_at(address)
        assert "640x480" in (await camera.connect()).model
        await camera.close()


async def test_an_address_that_is_refused_says_why():
    async with serving(b"HTTP/1.0 401 Unauthorized\r\n\r\n") as address:
        with pytest.raises(ConnectionLost, match="HTTP Error 401: Unauthorized"):
            await camera_at(address).connect()


async def test_a_file_that_is_missing_or_over_is_a_lost_connection(tmp_path: Path) -> None:
    with pytest.raises(ConnectionLost):
        await camera_at(str(tmp_path / "nowhere.avi")).connect()
    path = tmp_path / "short.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (640, 480), isColor=False)
    for _ in range(5):
        writer.write(page())
    writer.release()
    with pytest.raises(DeviceError, match="gain cannot be set through"):
        await camera_at(str(path), locked=Locked(gain=1.0)).connect()
    camera = camera_at(str(path))
    await camera.connect()
    with pytest.raises(ConnectionLost, match="ended"):
        await camera.fresh(Stamp(CLOCK.now_ns() + 3600 * 10**9))
    await camera.close()


class FakeDevice:
    """A `cv2.VideoCapture` on a device that has settings; exposure goes in steps of 10."""

    def __init__(self, *_: object) -> None:
        self.values: dict[int, float] = {}
        self.calls: list[tuple[int, float]] = []

    def isOpened(self) -> bool:
        return True

    def set(self, name: int, value: float) -> bool:
        self.calls.append((name, value))
        self.values[name] = round(value / 10) * 10 if name == cv2.CAP_PROP_EXPOSURE else value
        return True

    def get(self, name: int) -> float:
        return self.values.get(name, 0.0)

    def read(self) -> tuple[bool, np.ndarray]:
        return True, page()

    def release(self) -> None:
        pass


async def test_settings_are_locked_read_back_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    device = FakeDevice()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: device)
    camera = camera_at("0", locked=Locked(width=640, height=480, exposure=150.0, gain=4.0, focus=30.0))
    identity = await camera.connect()
    assert identity.model == "0 640x480, width 640, height 480, exposure 150, gain 4, focus 30"
    automatic_off = device.calls.index((cv2.CAP_PROP_AUTO_EXPOSURE, 1.0))
    assert automatic_off < device.calls.index((cv2.CAP_PROP_EXPOSURE, 150.0))
    await camera.close()
    with pytest.raises(DeviceError, match="exposure = 156 was asked for, but 160 is read back"):
        await camera_at("0", locked=Locked(exposure=156.0)).connect()
