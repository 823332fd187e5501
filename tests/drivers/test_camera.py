"""The camera: no frame older than asked, frames that must not be believed are passed over, settings are locked."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brushloop.drivers.camera import CameraTable, Locked, OpenCvCamera, opencv
from brushloop.drivers.camera.opencv import FrameFault, FrameHealth
from brushloop.drivers.devices import Camera, Pose, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.faults import ALWAYS, Fault, FaultBoard
from brushloop.drivers.sim.mjpeg_server import MjpegServer
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import World
from tests.waiting import PATIENCE_S, until

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
    server = MjpegServer(StampedScene(faults._world), replace(small_view, fps=15.0, jpeg_quality=90), faults)
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
    assert isinstance(camera, Camera)
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
        ("black", r"\(The picture is black: lens covered or light off\? frames skipped: \d+ black"),
        ("frozen", r"frames skipped: .*\d+ frozen"),
        ("torn", r"frames skipped: .*\d+ torn"),
    ],
)
async def test_frames_that_are_no_picture_are_a_timeout_that_names_them_and_then_it_goes_on(
    faults: FaultBoard, camera: OpenCvCamera, notices: list[str], kind: str, words: str
):
    ident = faults.hang(Fault.model_validate({"device": "camera", "kind": kind, "count": ALWAYS}))
    await until(lambda: any(kind in notice for notice in notices), f"a notice of {kind} frames")
    impatient(camera)
    with pytest.raises(DeviceTimeout, match=words):
        await camera.fresh(Stamp(CLOCK.now_ns() + 10**9))
    faults.take(ident)
    camera._grabber._table = camera._table  # type: ignore[union-attr]
    asked_ns = CLOCK.now_ns()
    assert await seen_after(camera, asked_ns) >= asked_ns


async def test_a_picture_that_comes_again_is_not_taken_for_new_even_once(faults: FaultBoard, camera: OpenCvCamera):
    """A freeze that begins just before a photograph is asked for is shorter than what is called frozen."""
    for _ in range(2):
        faults.hang(Fault.model_validate({"device": "camera", "kind": "frozen", "count": 4}))
        asked_ns = CLOCK.now_ns()
        assert await seen_after(camera, asked_ns) >= asked_ns


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


async def test_frames_that_are_skipped_again_and_again_are_reported_once(
    monkeypatch: pytest.MonkeyPatch, notices: list[str]
):
    stuttering = Stuttering()
    monkeypatch.setattr(opencv, "CaptureSource", lambda _table: stuttering)
    camera = OpenCvCamera(CameraTable(kind="opencv", source="scripted"), stuttering, notices.append)
    await camera.connect()
    await asyncio.to_thread(stuttering.over.wait, PATIENCE_S)
    await camera.close()
    assert len(notices) == 2, notices


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

    live, independent, simulated = True, False, True
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
    monkeypatch.setattr(opencv, "CaptureSource", lambda _table: next(sources))
    monkeypatch.setattr(opencv, "JOIN_S", 0.01)
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

PERIOD = 100_000_000
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


def health(latency_ns: int = 250_000_000, *, independent: bool = False) -> FrameHealth:
    return FrameHealth(latency_ns=latency_ns, live=True, independent=independent)


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
    assert health().judge(image, 0) is fault


def test_a_picture_whose_end_is_to_the_bit_that_of_the_one_before_is_torn():
    """FFmpeg fills what is missing of a JPEG with the last whole picture, so that it looks sound."""
    first, second, third = page(), page(), page()
    patched, again = second.copy(), third.copy()
    patched[300:], again[400:] = first[300:], first[400:]
    jpegs = health(0, independent=True)
    judged = [jpegs.judge(image, k * PERIOD) for k, image in enumerate((first, patched, again, third, third))]
    assert judged == [None, FrameFault.TORN, FrameFault.TORN, None, None]
    video = health(0)  # repeats what does not move, and may
    assert [video.judge(image, k * PERIOD) for k, image in enumerate((first, patched))] == [None, None]


def test_the_fifth_equal_frame_is_frozen_and_a_new_one_thaws() -> None:
    judged, image = health(), page()
    faults = [judged.judge(image, k * PERIOD) for k in range(6)]
    assert faults == [None, None, None, None, FrameFault.FROZEN, FrameFault.FROZEN]
    assert judged.judge(page(), 6 * PERIOD) is None
    assert judged.summary() == "2 frozen"


MS = 1_000_000
ARRIVALS: dict[str, tuple[int, list[int], list[int]]] = {
    "a backlog after a pause": (250, [*range(0, 600, 100), 2500, 2501, 2502, 2602, 2702], [6, 7, 8]),
    "slow at first, then fast": (250, [*range(0, 2000, 500), *range(3500, 4700, 100)], [4, 5, 6, 7, 8]),
}


@pytest.mark.parametrize(("latency_ms", "arrivals_ms", "late"), ARRIVALS.values(), ids=ARRIVALS.keys())
def test_frames_that_waited_in_a_buffer_are_late(latency_ms: int, arrivals_ms: list[int], late: list[int]) -> None:
    judged = health(latency_ms * MS)
    faults = [judged.judge(page(), at_ms * MS) for at_ms in arrivals_ms]
    assert [k for k, fault in enumerate(faults) if fault is FrameFault.LATE] == late


def test_a_camera_whose_first_frames_come_in_a_burst_is_late_for_a_few_frames_only() -> None:
    judged = health(60 * MS)
    for at_ms in range(0, 25, 5):
        judged.judge(page(), at_ms * MS)
    faults = [judged.judge(page(), at_ms * MS) for at_ms in range(100, 3300, 80)]
    assert faults[0] is FrameFault.LATE
    assert faults[5:] == [None] * 35


# ---------------------------------------------------------------- recordings and settings


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
