"""What the drivers do while a fault on the rig's board lasts: the arm's, the camera's, the force sensor's."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator

import numpy as np
import pytest

from brushloop.drivers.arcs import stopping
from brushloop.drivers.arcs.controller import RobotMode, SafetyMode
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.camera import CameraOptions, OpenCvCamera
from brushloop.drivers.camera.opencv import FrameFault, FrameHealth
from brushloop.drivers.devices import Stamp
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    MotionFailed,
    ProtocolViolation,
    RobotNotSafe,
)
from brushloop.drivers.force import sri_m8123
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL, SriM8123, SriOptions
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault, FaultBoard
from brushloop.drivers.sim.rig import HOST, LoopbackRig
from brushloop.drivers.sim.scene import read_strip
from tests.waiting import wait_until

RPC_TIMEOUT_S = 0.4


@pytest.fixture(autouse=True)
def impatient() -> Iterator[None]:
    # A patch of its own: `monkeypatch` would be undone after the arm is closed, and tests rely on its being before.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stopping, "CONFIRM_S", 1.5)
        patch.setitem(RpcConnection.__init__.__kwdefaults__, "timeout_s", RPC_TIMEOUT_S)
        yield


FAR = brush_pose(250.0, -30.0, 260.0)  # 200 mm from home
SLOW = {"speed_mm_s": 5.0, "acc_mm_s2": 800.0}  # two real seconds
QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}
POLL = "getSafetyModeType"  # what a move asks for while it waits, and telemetry does not


def robot(kind: str, **more: object) -> Fault:
    return Fault.model_validate({"device": Device.ROBOT, "kind": kind, **more})


def to_go_mm(cabinet: ArcsServer) -> float:
    return distance(cabinet.cabinet.world.tool(), FAR)[0]


def at_rest(cabinet: ArcsServer) -> bool:
    return cabinet.cabinet.motion.exec_id(cabinet.cabinet.now_s()) == -1


ENDS: list[tuple[str, type[DeviceError], str]] = [
    ("mute", DeviceTimeout, "no reply"),
    ("late", DeviceTimeout, "no reply"),
    ("wrong-id", DeviceTimeout, "no reply"),
    ("malformed", ProtocolViolation, "reply is not JSON"),
    ("garbage", ConnectionLost, "expected SOF"),
    ("drop", ConnectionLost, "closed the connection"),
]


@pytest.mark.parametrize("on", ["moveLine", POLL])
@pytest.mark.parametrize(("kind", "error", "words"), ENDS)
async def test_one_bad_reply_ends_the_move_with_its_name_and_the_arm_rests_on_its_way(
    arm: AuboArcs, cabinet: ArcsServer, kind: str, error: type[DeviceError], words: str, on: str
):
    more = {"late_s": 1.0} if kind == "late" else {}
    cabinet.faults.hang(robot(kind, on=on, nth=1 if on == "moveLine" else 5, **more))
    with pytest.raises(error, match=words) as caught:
        await arm.move(FAR, **SLOW)
    assert on in caught.value.op
    assert not getattr(caught.value, "__notes__", []), "the arm was seen at rest"
    assert at_rest(cabinet)
    left_mm = to_go_mm(cabinet)
    assert 50.0 < left_mm < 200.0
    await asyncio.sleep(0.7 if kind == "late" else 0.1)  # the late reply comes, and nothing comes of it
    assert to_go_mm(cabinet) == left_mm


async def test_a_line_that_never_arrives_is_a_timeout_and_nothing_has_moved(arm: AuboArcs, cabinet: ArcsServer):
    cabinet.faults.hang(robot("deaf", on="moveLine"))
    with pytest.raises(DeviceTimeout, match="moveLine"):
        await arm.move(FAR, **SLOW)
    assert to_go_mm(cabinet) == pytest.approx(200.0)


@pytest.mark.parametrize("kind", ["mute", "deaf"])
async def test_a_controller_that_falls_silent_is_reported_as_an_arm_that_may_still_move(
    arm: AuboArcs, cabinet: ArcsServer, kind: str
):
    """`mute` carries out the stop and cannot say so, `deaf` does not: from outside both look alike."""
    cabinet.faults.hang(robot(kind, phase="travelling", nth=5, count=ALWAYS))
    with pytest.raises(DeviceTimeout) as caught:
        await arm.move(FAR, **SLOW)
    [note] = caught.value.__notes__
    assert "The arm may still be moving. Use the emergency stop." in note
    if kind == "mute":
        assert at_rest(cabinet)
    with pytest.raises(MotionFailed, match="may still be moving"):
        await arm.close()


@pytest.mark.parametrize(
    ("kind", "mode", "condition", "power"),
    [
        ("protective-stop", SafetyMode.PROTECTIVE_STOP, "brakes open", RobotMode.RUNNING),
        ("safeguard-stop", SafetyMode.SAFEGUARD_STOP, "brakes on", RobotMode.RUNNING),
        ("emergency-stop", SafetyMode.ROBOT_EMERGENCY_STOP, "no power", RobotMode.POWER_OFF),
    ],
)
async def test_a_safety_stop_in_mid_move_is_named_with_its_condition_and_stays_until_a_person_ends_it(
    rig: LoopbackRig,
    arm_at: Callable[[int], AuboArcs],
    kind: str,
    mode: SafetyMode,
    condition: str,
    power: RobotMode,
):
    arm = arm_at(rig.arcs.port)
    await arm.connect()
    await arm.enable()
    rig.faults.hang(robot(kind, phase="travelling"))  # begins by itself, once the arm has left
    with pytest.raises(RobotNotSafe) as caught:
        await arm.move(FAR, **SLOW)
    assert caught.value.mode == mode
    assert condition in caught.value.condition
    assert caught.value.remedy
    assert at_rest(rig.arcs)
    left_mm = to_go_mm(rig.arcs)
    assert 100.0 < left_mm < 200.0
    assert (rig.arcs.cabinet.power.safety, rig.arcs.cabinet.power.mode) == (mode, power)

    assert rig.arcs.cabinet.release() == mode
    assert rig.arcs.cabinet.power.safety == SafetyMode.NORMAL
    rig.arcs.cabinet.resume()  # whoever resumes finds no path: the driver's own stop has dropped it
    await asyncio.sleep(0.1)
    assert to_go_mm(rig.arcs) == left_mm
    await arm.enable()
    await arm.move(FAR, **QUICK)
    await arm.close()


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
    options = SriOptions("socketcand", LOOPBACK_CHANNEL, host=HOST, port=rig.force.port, stale_after_ms=5000.0)
    sensor = SriM8123(options, HostClock())
    await sensor.connect()
    yield sensor
    await sensor.close()


async def test_a_sensor_that_was_silent_is_heard_again_as_soon_as_the_fault_is_cleared(
    rig: LoopbackRig, sensor: SriM8123
):
    rig.faults.hang(Fault(device=Device.FORCE, kind="silence", count=1_000_000))
    await asyncio.sleep(0.3)
    assert rig.faults.clear() == 1
    cleared = sensor.latest().stamp.seq
    async with asyncio.timeout(4.0):
        while sensor.latest().stamp.seq == cleared:
            await asyncio.sleep(0.005)


async def test_a_rig_without_the_instrument_refuses_its_faults(rig: LoopbackRig):
    bare = FaultBoard(rig.world, [Device.INK])
    with pytest.raises(ValueError, match="device = 'ink': this rig has none"):
        bare.hang(Fault(device=Device.INK, kind="garbage"))
