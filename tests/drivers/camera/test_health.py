"""Frames that must not be believed are named, and passed over until a sound one comes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.drivers.camera import CameraOptions, Locked, OpenCvCamera
from brushloop.drivers.camera.opencv import FrameFault, FrameHealth
from brushloop.drivers.devices import Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout
from brushloop.drivers.host import HostClock

CLOCK = HostClock()
PERIOD = 100_000_000
RNG = np.random.default_rng(0)


def page(level: float = 220.0, noise: float = 2.0) -> np.ndarray:
    return np.clip(RNG.normal(level, noise, (480, 640)), 0, 255).astype(np.uint8)


def health(**changes: object) -> FrameHealth:
    options: dict[str, object] = {"latency_ns": 250_000_000, "frozen_after": 5, "live": True}
    return FrameHealth(**(options | changes))  # type: ignore[arg-type]


def test_a_page_with_ink_is_sound() -> None:
    image = page()
    image[200:260, 100:500] = 20
    assert health().judge(image, 0) is None


def test_a_lens_cap_is_black_though_not_quite_zero() -> None:
    assert health().judge(page(8.0, 3.0), 0) is FrameFault.BLACK


def test_an_overexposed_page_is_saturated_but_a_white_one_is_not() -> None:
    assert health().judge(page(300.0), 0) is FrameFault.SATURATED
    assert health().judge(page(245.0), 0) is None


@pytest.mark.parametrize("fill", [0, 128, 200])
def test_a_frame_whose_lower_part_never_arrived_is_torn(fill: int) -> None:
    image = page()
    image[400:] = fill
    assert health().judge(image, 0) is FrameFault.TORN


def test_the_fifth_equal_frame_is_frozen_and_a_new_one_thaws() -> None:
    judged, image = health(), page()
    faults = [judged.judge(image, k * PERIOD) for k in range(6)]
    assert faults == [None, None, None, None, FrameFault.FROZEN, FrameFault.FROZEN]
    assert judged.judge(page(), 6 * PERIOD) is None
    assert judged.summary() == "2 frozen"


def test_a_camera_that_was_slow_at_first_is_not_late_for_ever_after_a_pause() -> None:
    """Its frames then come faster than half the period that was known, as those of a backlog do."""
    judged = health()
    slow = [k * 500_000_000 for k in range(4)]
    resumed = [slow[-1] + 2_000_000_000 + k * 100_000_000 for k in range(12)]
    assert [judged.judge(page(), t) for t in slow] == [None] * 4
    assert [judged.judge(page(), t) for t in resumed] == [FrameFault.LATE] * 5 + [None] * 7


def test_a_camera_whose_first_frames_come_in_a_burst_is_late_for_a_few_frames_only() -> None:
    judged = health(latency_ns=60_000_000)
    burst = [k * 5_000_000 for k in range(5)]
    steady = [burst[-1] + (k + 1) * 80_000_000 for k in range(40)]
    for t in burst:
        judged.judge(page(), t)
    found = [judged.judge(page(), t) for t in steady]
    assert found[0] is FrameFault.LATE
    assert found[5:] == [None] * 35


def test_a_backlog_after_a_pause_is_late_until_frames_come_at_their_own_pace() -> None:
    judged = health()
    arrivals = [k * PERIOD for k in range(6)]
    assert [judged.judge(page(), t) for t in arrivals] == [None] * 6
    resumed = arrivals[-1] + 2_000_000_000
    burst = [resumed, resumed + 1_000_000, resumed + 2_000_000]
    assert [judged.judge(page(), t) for t in burst] == [FrameFault.LATE] * 3
    assert judged.judge(page(), burst[-1] + PERIOD) is None
    assert judged.judge(page(), burst[-1] + 2 * PERIOD) is None


async def test_a_folder_of_images_is_shown_in_order_and_the_last_one_stays(tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), page(100.0 + 10 * k)[:48, :64])
    camera = OpenCvCamera(CameraOptions(str(tmp_path), latency_ms=0.0, folder_fps=50.0), CLOCK)
    await camera.connect()
    for _ in range(8):
        frame = await camera.fresh(Stamp(CLOCK.now_ns()))
    assert frame.image.mean() == pytest.approx(120, abs=1.0)
    await camera.close()


async def test_an_empty_folder_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    for source in (str(tmp_path), str(tmp_path / "nowhere.avi")):
        with pytest.raises(ConnectionLost):
            await OpenCvCamera(CameraOptions(source, timeout_s=2.0), CLOCK).connect()


async def test_a_file_that_ends_is_over(tmp_path: Path) -> None:
    path = str(tmp_path / "short.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 10, (640, 480), isColor=False)
    for _ in range(5):
        writer.write(page())
    writer.release()
    camera = OpenCvCamera(CameraOptions(path, timeout_s=3.0), CLOCK)
    await camera.connect()
    with pytest.raises(ConnectionLost, match="ended"):
        await camera.fresh(Stamp(CLOCK.now_ns() + 10**9))
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
    options = CameraOptions("0", locked=Locked(width=640, height=480, exposure=150.0, gain=4.0, focus=30.0))
    camera = OpenCvCamera(options, CLOCK)
    identity = await camera.connect()
    assert identity.model == "0 640x480, width 640, height 480, exposure 150, gain 4, focus 30"
    automatic_off = device.calls.index((cv2.CAP_PROP_AUTO_EXPOSURE, 1.0))
    assert automatic_off < device.calls.index((cv2.CAP_PROP_EXPOSURE, 150.0))
    await camera.close()


async def test_a_setting_that_does_not_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", FakeDevice)
    with pytest.raises(DeviceError, match="exposure = 156 was asked for, but 160 is read back"):
        await OpenCvCamera(CameraOptions("0", locked=Locked(exposure=156.0)), CLOCK).connect()


async def test_settings_cannot_be_locked_through_a_file(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (640, 480), isColor=False)
    writer.write(page())
    writer.release()
    with pytest.raises(DeviceError, match="gain cannot be set through"):
        await OpenCvCamera(CameraOptions(str(path), locked=Locked(gain=1.0)), CLOCK).connect()


async def test_a_camera_that_only_shows_black_times_out_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Dark(FakeDevice):
        def read(self) -> tuple[bool, np.ndarray]:
            return True, page(5.0, 1.0)

    monkeypatch.setattr(cv2, "VideoCapture", Dark)
    with pytest.raises(
        DeviceTimeout, match=r"The picture is black: lens covered or light off\? frames skipped: \d+ black"
    ):
        await OpenCvCamera(CameraOptions("0", timeout_s=0.5), CLOCK).connect()
