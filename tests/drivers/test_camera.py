"""The camera: no frame older than asked, frames that must not be believed are passed over, settings are locked."""

from __future__ import annotations

import asyncio
import queue
import re
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from brushloop.collect.commission.camera import found_settings, video_devices
from brushloop.drivers import camera as camera_module
from brushloop.drivers.camera import OpenCvCamera, is_late, looked_at
from brushloop.drivers.camera.source import CameraTable, Capture, Locked
from brushloop.drivers.devices import Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout
from brushloop.drivers.host import Clock
from brushloop.drivers.loopback import LoopbackServer
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.scene import black, renumbered, torn
from tests.waiting import until

RNG = np.random.default_rng(0)


def page(level: float = 220.0, noise: float = 2.0) -> np.ndarray:
    return np.clip(RNG.normal(level, noise, (480, 640)), 0, 255).astype(np.uint8)


def jpeg_of(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


SOUND = jpeg_of(page())


class Feed:
    """A source whose pictures a test hands over, and its clock: a picture comes a tenth of a second after the other."""

    simulated = False
    settings: ClassVar[dict[str, float]] = {}

    def __init__(self) -> None:
        self.t_ns = 10**12
        self._pictures: queue.Queue[bytes | NDArray[np.uint8] | None] = queue.Queue()
        self.notices: list[str] = []
        """What the camera said of it."""

    def now_ns(self) -> int:
        return self.t_ns

    def show(self, *pictures: bytes | NDArray[np.uint8] | None) -> None:
        """These come next; None ends the stream."""
        for picture in pictures:
            self._pictures.put(picture)

    def read(self) -> bytes | NDArray[np.uint8] | None:
        picture = self._pictures.get()
        self.t_ns += 100_000_000
        return picture

    def close(self) -> None:
        pass


@pytest.fixture
def feed() -> Feed:
    return Feed()


@pytest.fixture
def sources(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> list[Feed]:
    """What each opening finds; nothing where the list is empty."""
    coming = [feed]

    def opened(_: CameraTable) -> Feed:
        if not coming:
            raise ConnectionLost("camera", "open", "nothing there")
        return coming.pop(0)

    monkeypatch.setattr(camera_module, "Capture", opened)
    return coming


@pytest.fixture
async def camera(feed: Feed, sources: list[Feed]) -> AsyncIterator[OpenCvCamera]:
    """Connected, over a feed that has shown `SOUND`; it gives up after two seconds."""
    table = CameraTable(kind="opencv", source="rtsp://camera", latency_ms=0.0)
    camera = OpenCvCamera(table, feed, feed.notices.append)
    feed.show(SOUND)
    await camera.connect()
    camera._table = table.model_copy(update={"timeout_s": 2.0})
    yield camera
    feed.show(None)
    await camera.close()


async def asked(camera: OpenCvCamera, feed: Feed) -> asyncio.Task[Any]:
    """A question for a frame that is exposed after now."""
    task = asyncio.create_task(camera.fresh(Stamp(feed.now_ns() + 1)))
    await asyncio.sleep(0)
    return task


def camera_at(source: str, **more: Any) -> OpenCvCamera:
    table = {"kind": "opencv", "source": source, "timeout_s": 60.0, **more}
    return OpenCvCamera(CameraTable.model_validate(table), Clock())


async def test_no_frame_is_older_than_asked_by_the_latency_and_the_first_is_as_old_as_the_connection(
    feed: Feed, sources: list[Feed]
):
    opened_ns = feed.now_ns()
    camera = OpenCvCamera(CameraTable(kind="opencv", source="rtsp://camera", latency_ms=250.0), feed)
    feed.show(page())
    identity = await camera.connect()
    assert (identity.model, identity.simulated) == ("rtsp://camera 640x480", False)
    assert (await camera.fresh(Stamp(0))).exposed_after_ns == opened_ns - 250_000_000
    pictures, asked_ns = [page() for _ in range(4)], feed.now_ns()
    waiting = asyncio.create_task(camera.fresh(Stamp(asked_ns)))
    feed.show(*pictures)
    frame = await waiting
    assert frame.exposed_after_ns >= asked_ns
    assert any(np.array_equal(frame.image, picture) for picture in pictures[2:])
    feed.show(None)
    await camera.close()


async def test_a_frame_is_decoded_only_when_somebody_looks(
    camera: OpenCvCamera, feed: Feed, monkeypatch: pytest.MonkeyPatch
):
    looks: list[object] = []
    monkeypatch.setattr(camera_module, "looked_at", lambda picture: (looks.append(picture), looked_at(picture))[1])
    jpegs = [jpeg_of(page()) for _ in range(5)]
    feed.show(*jpegs)
    await until(lambda: camera._newest[2] is jpegs[-1], "the pictures")
    assert not looks
    await camera.fresh(Stamp(0))
    assert looks == jpegs[-1:]


async def test_a_stream_that_ends_is_opened_again_and_both_are_reported(
    camera: OpenCvCamera, feed: Feed, sources: list[Feed]
):
    feed.show(None)
    await until(lambda: feed.notices, "the end of the stream")
    with pytest.raises(DeviceTimeout, match="the stream ended and is opened again"):
        await camera.fresh(Stamp(feed.now_ns() + 1))
    second = Feed()
    sources.append(second)
    await until(lambda: len(feed.notices) == 2, "the stream to be opened")
    second.show(picture := page())
    await until(lambda: camera._newest[2] is picture, "a picture")
    assert np.array_equal((await camera.fresh(Stamp(0))).image, picture)
    assert feed.notices[0] == "camera: the stream ended and is opened again"
    assert feed.notices[1].startswith("camera is back after")
    second.show(None)


@pytest.mark.parametrize(
    ("pictures", "words"),
    [
        ([black(SOUND)], "(The picture is black: lens covered or light off? frames skipped: 1 black)"),
        ([torn(SOUND), torn(SOUND)[:-9]], "(frames skipped: "),
        ([renumbered(SOUND, 1), renumbered(SOUND, 2)], "(frames skipped: 2 frozen)"),
    ],
    ids=["black", "torn", "frozen"],
)
async def test_frames_that_are_no_picture_are_a_timeout_that_names_them_and_then_it_goes_on(
    camera: OpenCvCamera, feed: Feed, pictures: list[bytes], words: str
):
    waiting = await asked(camera, feed)
    feed.show(*pictures)
    with pytest.raises(DeviceTimeout, match=re.escape(words)):
        await waiting
    waiting = await asked(camera, feed)
    feed.show(picture := page())
    assert np.array_equal((await waiting).image, picture)


async def test_closing_never_hands_an_old_frame_to_whoever_still_waits(camera: OpenCvCamera, feed: Feed):
    waiting = await asked(camera, feed)
    feed.show(None)
    await camera.close()
    with pytest.raises(ConnectionLost, match="closed"):
        await waiting


async def test_a_server_that_says_nothing_is_given_up():
    mute = LoopbackServer()  # takes connections, and never answers
    await mute.start(HOST, 0)
    camera = camera_at(f"http://{HOST}:{mute.port}/", timeout_s=0.5)
    with pytest.raises(DeviceError):
        await camera.connect()
    await camera.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "camera grabber"]
    await mute.stop()


# ---------------------------------------------------------------- one frame after the other


def filled(rows: slice, columns: slice, level: int) -> np.ndarray:
    image = page()
    image[rows, columns] = level
    return image


END = slice(400, None)
WHOLE = slice(None)


@pytest.mark.parametrize(
    ("image", "fault"),
    [
        (filled(slice(200, 260), slice(100, 500), 20), None),
        (page(8.0, 3.0), "black"),
        (page(300.0), "saturated"),
        (page(245.0), None),
        (filled(END, WHOLE, 0), "torn"),
        (filled(END, WHOLE, 200), "torn"),
    ],
    ids=["ink", "lens cap", "overexposed", "white paper", "black end", "gray end"],
)
def test_one_frame_is_judged_by_what_it_shows(image: np.ndarray, fault: str | None) -> None:
    seen = looked_at(image)
    assert seen is image if fault is None else seen == fault


def test_a_jpeg_is_the_same_picture_in_gray_and_one_that_is_cut_off_is_torn(capfd: pytest.CaptureFixture[str]) -> None:
    colours = np.dstack([page(200.0), page(100.0), page(150.0)])
    jpeg = jpeg_of(colours)
    seen = looked_at(jpeg)
    assert isinstance(seen, np.ndarray)
    assert np.abs(seen.astype(float) - cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)).mean() < 3.0
    for size in (1, 200, len(jpeg) // 2, len(jpeg) - 2):
        assert looked_at(jpeg[:size]) == "torn"
    assert looked_at(torn(jpeg)) == "torn"
    huge, at = bytearray(jpeg), jpeg.index(b"\xff\xc0") + 5  # height and width in the frame's header
    huge[at : at + 4] = (20_000).to_bytes(2, "big") * 2
    assert looked_at(bytes(huge)) == "torn"
    assert not capfd.readouterr().err, "a decoder that writes on the terminal would spoil the screen"


MS = 1_000_000
ARRIVALS: dict[str, tuple[int, list[int], list[int]]] = {
    "a backlog after a pause": (250, [*range(0, 600, 100), 2500, 2501, 2502, 2602, 2702], [6, 7, 8]),
    "slow at first, then fast": (250, [*range(0, 2000, 500), *range(3500, 4700, 100)], [4, 5, 6, 7, 8, 9]),
    "fast at first, then slow": (250, [*range(0, 1000, 100), *range(1400, 9000, 500)], list(range(10, 19))),
    "a burst at first": (60, [*range(0, 25, 5), *range(100, 3300, 80)], [5, 6, 7, 8]),
}


@pytest.mark.parametrize(("latency_ms", "arrivals_ms", "late"), ARRIVALS.values(), ids=ARRIVALS.keys())
def test_frames_that_waited_in_a_buffer_are_late(latency_ms: int, arrivals_ms: list[int], late: list[int]) -> None:
    gaps_ns = [(b - a) * MS for a, b in pairwise(arrivals_ms)]
    assert [k for k in range(1, len(arrivals_ms)) if is_late(gaps_ns[:k], latency_ms * MS)] == late


# ---------------------------------------------------------------- sources and settings


class Answer(LoopbackServer):
    """Gives every client the same answer, then a byte at a time."""

    def __init__(self, answer: bytes, trickle: bytes) -> None:
        super().__init__()
        self.answer, self.trickle = answer, trickle

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(self.answer)
        for byte in self.trickle:
            await asyncio.sleep(0.01)
            self.write(writer, bytes([byte]))


@asynccontextmanager
async def serving(answer: bytes, trickle: bytes = b"") -> AsyncIterator[str]:
    """The address of such a server."""
    server = Answer(answer, trickle)
    await server.start(HOST, 0)
    try:
        yield f"http://{HOST}:{server.port}/"
    finally:
        await server.stop()


MULTIPART = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=b\r\n\r\n"
PART = b"--b\r\nContent-Type: image/jpeg\r\ncontent-length: %d\r\n\r\n" % len(SOUND) + SOUND + b"\r\n"


@pytest.mark.parametrize(
    ("answer", "trickle", "jpegs"),
    [
        (MULTIPART + 2 * PART, b"", 2),
        (MULTIPART + 5 * PART.replace(b"length", b"width"), b"", 4),
        (MULTIPART + PART + PART[:-99], b"", 1),
        (MULTIPART + PART + b"\xff" * 99_999, b"", 1),
        (MULTIPART + PART + PART[:-500], PART[-500:], 1),
    ],
    ids=["ends", "without lengths", "cut off", "garbage", "trickles in"],
)
async def test_jpegs_of_a_stream_are_handed_over_as_they_came_and_one_that_is_cut_off_or_only_trickles_in_is_torn(
    answer: bytes, trickle: bytes, jpegs: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("http_proxy", f"http://{HOST}:9")  # no camera is behind it
    async with serving(answer, trickle) as address:
        table = CameraTable(kind="opencv", source=address, timeout_s=1.0 if trickle else 60.0)
        source = await asyncio.to_thread(Capture, table)
        assert not source.simulated
        for _ in range(jpegs):
            assert await asyncio.to_thread(source.read) == SOUND
        while (cut := await asyncio.to_thread(source.read)) is not None:
            assert looked_at(cut) == "torn"
        source.close()


async def test_a_stream_that_needs_a_password_is_read_and_an_answer_that_is_no_stream_of_pictures_is_refused():
    async with serving(MULTIPART + 2 * PART) as address:
        camera = camera_at(address.replace("//", "//user:secret@"))
        assert "640x480" in (await camera.connect()).model
        await camera.close()
    for answer, words in (
        (MULTIPART + b"boundary\r\n" * 200_000, "cannot open"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: video/mp4\r\n\r\n", "cannot open"),
        (b"HTTP/1.0 401 Unauthorized\r\n\r\n", "HTTP Error 401: Unauthorized"),
    ):
        async with serving(answer) as address:
            with pytest.raises(ConnectionLost, match=words):
                await camera_at(address).connect()


@pytest.mark.parametrize("recording", ["short.avi", "file:///short.avi"])
async def test_a_recording_is_no_camera_and_a_stream_has_no_settings(recording: str) -> None:
    with pytest.raises(ConnectionLost, match="neither the number of a device nor the address of a stream"):
        await camera_at(recording).connect()
    with pytest.raises(DeviceError, match="gain cannot be set through"):
        await camera_at("rtsp://camera", locked=Locked(gain=1.0)).connect()


async def test_settings_are_locked_read_back_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    values: dict[int, float] = {}

    def set_value(name: int, value: float) -> None:
        """Exposure goes in steps of 10, and only by hand."""
        if name != cv2.CAP_PROP_EXPOSURE:
            values[name] = value
        elif values.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 1.0:
            values[name] = round(value / 10) * 10

    device = Mock(set=set_value, get=lambda name: values.get(name, 0.0), read=lambda: (True, page()))
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: device)
    camera = camera_at("0", locked=Locked(width=640, height=480, exposure=150.0, gain=4.0, focus=30.0))
    identity = await camera.connect()
    assert identity.model == "0 640x480, width 640, height 480, exposure 150, gain 4, focus 30"
    await camera.close()
    read_back = {"width": 640.0, "height": 480.0, "exposure": 150.0, "gain": 4.0, "focus": 30.0}
    assert await asyncio.to_thread(found_settings, 0, 0.0) == read_back, "it has no white balance"
    with pytest.raises(DeviceError, match="exposure = 156 was asked for, but 160 is read back"):
        await camera_at("0", locked=Locked(exposure=156.0)).connect()


def test_two_cameras_of_one_kind_are_told_apart_by_serial_number_or_by_socket(tmp_path: Path) -> None:
    for link, device in (("path/usb-1", "video0"), ("path/usb-2", "video2"), ("id/Camera_SN42", "video0")):
        (tmp_path / device).touch()
        (tmp_path / "v4l" / f"by-{link}").parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "v4l" / f"by-{link}").symlink_to(tmp_path / device)
    assert video_devices(tmp_path) == {"0": "0 (Camera_SN42)", "2": "2 (usb-2)"}
