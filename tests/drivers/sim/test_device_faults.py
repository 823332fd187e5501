"""What the drivers do while a fault on the rig's board lasts: the arm's, the camera's, the force sensor's."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import numpy as np
import pytest

from brushloop.drivers.camera import CameraOptions, OpenCvCamera
from brushloop.drivers.camera.opencv import FrameFault, FrameHealth
from brushloop.drivers.devices import Stamp
from brushloop.drivers.errors import (
    DeviceTimeout,
)
from brushloop.drivers.force import sri_m8123
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL, SriM8123, SriOptions
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault, FaultBoard
from brushloop.drivers.sim.rig import HOST, LoopbackRig
from brushloop.drivers.sim.scene import read_strip
from tests.waiting import until, wait_until

CLOCK = HostClock()


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
async def camera(rig: LoopbackRig, notices: list[str]) -> AsyncIterator[OpenCvCamera]:
    url = f"http://{HOST}:{rig.camera.port}/stream.mjpg"
    camera = OpenCvCamera(CameraOptions(url, timeout_s=1.5), CLOCK, notices.append)
    await camera.connect()
    yield camera
    await camera.close()


def view(kind: str, **more: object) -> Fault:
    return Fault.model_validate({"device": Device.CAMERA, "kind": kind, **more})


async def seen_after(camera: OpenCvCamera, after_ns: int) -> int:
    """When the frame that the driver hands over was really rendered."""
    return read_strip((await camera.fresh(Stamp(after_ns))).image)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("black", r"\(The picture is black: lens covered or light off\? frames skipped: \d+ black"),
        ("frozen", r"frames skipped: .*\d+ frozen"),
        ("torn", r"frames skipped: .*\d+ torn"),
    ],
)
async def test_frames_that_are_no_picture_are_a_timeout_that_names_them_and_then_it_goes_on(
    rig: LoopbackRig, camera: OpenCvCamera, notices: list[str], kind: str, words: str
):
    ident = rig.faults.hang(view(kind, count=ALWAYS))
    with pytest.raises(DeviceTimeout, match=words):
        # The first of equal frames cannot be distinguished from a new one: ask for what is exposed well after it.
        await camera.fresh(Stamp(CLOCK.now_ns() + 10**9))
    # From the thread that reads the stream.
    await asyncio.to_thread(wait_until, lambda: any(kind in one for one in notices), f"a notice of {kind} frames")
    rig.faults.take(ident)
    asked_ns = CLOCK.now_ns()
    assert await seen_after(camera, asked_ns) >= asked_ns


async def test_of_a_backlog_that_comes_at_once_nothing_is_taken_for_new(rig: LoopbackRig, camera: OpenCvCamera):
    """After a stall the stream hands over what it held back, oldest first, as a camera's buffer does."""
    await camera.fresh(Stamp(CLOCK.now_ns()))  # the driver knows the usual pace
    rig.faults.hang(view("stale", for_s=1.0))
    await asyncio.sleep(0.1)
    for _ in range(7):
        asked_ns = CLOCK.now_ns()
        assert await seen_after(camera, asked_ns) >= asked_ns
        await asyncio.sleep(0.05)


def test_a_picture_whose_end_is_to_the_bit_that_of_the_one_before_is_torn():
    """FFmpeg fills what is missing of a JPEG with the last whole picture, so that it looks sound."""
    rng = np.random.default_rng(1)
    first, second, third = (rng.normal(200.0, 2.0, (480, 640)).clip(0, 255).astype(np.uint8) for _ in range(3))
    patched, again = second.copy(), third.copy()
    patched[300:], again[400:] = first[300:], first[400:]
    jpegs = FrameHealth(latency_ns=0, frozen_after=5, live=True, independent=True)
    judged = [jpegs.judge(image, k * 10**8) for k, image in enumerate((first, patched, again, third, third))]
    assert judged == [None, FrameFault.TORN, FrameFault.TORN, None, None]
    video = FrameHealth(latency_ns=0, frozen_after=5, live=True)  # repeats what does not move, and may
    assert [video.judge(image, k * 10**8) for k, image in enumerate((first, patched))] == [None, None]


async def test_a_picture_that_comes_again_is_not_taken_for_new_even_once(rig: LoopbackRig, camera: OpenCvCamera):
    """A freeze that begins just before a photograph is asked for is shorter than what is called frozen."""
    for _ in range(3):
        rig.faults.hang(view("frozen", count=4))
        asked_ns = CLOCK.now_ns()
        assert await seen_after(camera, asked_ns) >= asked_ns


@pytest.fixture
async def sensor(rig: LoopbackRig, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[SriM8123]:
    assert rig.force is not None
    monkeypatch.setattr(sri_m8123, "ROUND_S", 0.5)  # a busy machine pauses within a round
    options = SriOptions(
        interface="socketcand", channel=LOOPBACK_CHANNEL, host=HOST, port=rig.force.port, stale_after_ms=1e6
    )
    sensor = SriM8123(options, HostClock())
    await sensor.connect()
    yield sensor
    await sensor.close()


async def test_a_sensor_that_was_silent_is_heard_again_as_soon_as_the_fault_is_cleared(
    rig: LoopbackRig, sensor: SriM8123
):
    rig.faults.hang(Fault(device=Device.FORCE, kind="silence", count=1_000_000))
    await until(lambda: rig.faults.hanging[0].struck > 10, "silent rounds")
    assert rig.faults.clear() == 1
    cleared = sensor.latest().stamp.seq
    await until(lambda: sensor.latest().stamp.seq > cleared, "a sample")


async def test_a_rig_without_the_instrument_refuses_its_faults(rig: LoopbackRig):
    bare = FaultBoard(rig.world, [Device.INK])
    with pytest.raises(ValueError, match="device = 'ink': this rig has none"):
        bare.hang(Fault(device=Device.INK, kind="garbage"))
