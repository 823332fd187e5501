"""RTDE pushes samples, polling takes over, and the lag of poses is measured."""

from __future__ import annotations

import asyncio
import itertools
import math
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import cbor2
import pytest

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.telemetry import (
    PING,
    LagMeter,
    RtdeStream,
    encode_sample,
    encode_topic,
)
from brushloop.drivers.arcs.wire import FrameDecoder, encode
from brushloop.drivers.devices import Pose, PoseSample, QueuedLine, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, ProtocolViolation, Stale
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.server import LoopbackServer
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.rig import HOST
from tests.drivers.arcs.conftest import MakeArm
from tests.drivers.failing import SetClock, mute
from tests.waiting import until

GREETING = b'{"protocol":"rtde","version":1,"input":{"set_recipe":100},"output":{"R1_actual_TCP_pose":1021}}\n\n'
POSE = ["R1_actual_TCP_pose"]
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


def test_a_topic_is_the_one_that_the_makers_client_sends():
    theirs = cbor2.loads(
        b"\x82\x18d\xa5fchanel\x00ifrequency\xfaBH\x00\x00hsegments\x82kR1_actual_qrR1_actual_TCP_poseito_server\xf4gtrigger\x1aAAAA"
    )
    [ours] = FrameDecoder().feed(encode_topic(0, ["R1_actual_q", "R1_actual_TCP_pose"], 50.0))
    command, topic = cbor2.loads(ours)
    assert (command, {**topic, "trigger": 0x41414141}) == (100, theirs[1])
    assert type(topic["frequency"]) is float


class Scripted(LoopbackServer):
    """Says to every client what its script says."""

    def __init__(self, script: Serve) -> None:
        super().__init__()
        self._script = script

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._script(reader, writer)


@pytest.fixture
async def served() -> AsyncIterator[Callable[[Serve], Awaitable[int]]]:
    """Serve one script on a port of its own."""
    servers: list[Scripted] = []

    async def serve(script: Serve) -> int:
        servers.append(Scripted(script))
        await servers[-1].start(HOST, 0)
        return servers[-1].port

    yield serve
    for server in servers:
        await server.stop()


def says(*pieces: bytes, then: str = "silence") -> Serve:
    async def script(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for piece in pieces:
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(0.01)
        if then == "silence":
            await asyncio.sleep(60.0)

    return script


async def outcome(port: int) -> list[Any]:
    stream = RtdeStream(HOST, port)
    try:
        await stream.open(POSE, 50.0)
        return await stream.newest()
    finally:
        await stream.close()


@pytest.mark.parametrize(
    ("script", "error"),
    [
        (says(), DeviceTimeout),
        (says(GREETING[:30]), DeviceTimeout),
        (says(then="end"), ConnectionLost),
        (says(GREETING.replace(b"R1_actual_TCP_pose", b"R1_other")), ProtocolViolation),
        (says(*[b"x" * 65536] * 10), ProtocolViolation),
        (says(GREETING), DeviceTimeout),
        (says(GREETING, then="end"), ConnectionLost),
        (says(GREETING, b"SOF\x01\x7f\xff\xff\xff"), ProtocolViolation),
        (says(GREETING, encode_sample(0, [])), ProtocolViolation),
        (says(GREETING, encode_sample(7, [1])), DeviceTimeout),
    ],
)
async def test_what_is_no_telemetry_is_distinguished(served: Any, script: Serve, error: type[Exception]):
    with pytest.raises(error):
        await outcome(await served(script))


@pytest.mark.parametrize("frame", [encode_sample(0, [[1, 2]]), encode(b"[0,[1,2]]"), PING + encode_sample(0, [[1, 2]])])
async def test_either_frame_is_taken(served: Any, frame: bytes):
    assert await outcome(await served(says(GREETING, frame))) == [[1, 2]]


async def test_of_a_backlog_only_the_newest_is_handed_over(served: Any):
    backlog = b"".join(encode_sample(0, [k]) for k in range(100))
    assert await outcome(await served(says(GREETING, backlog))) == [99]


@pytest.fixture
async def rtde(cabinet: ArcsServer) -> AsyncIterator[RtdeServer]:
    server = RtdeServer(cabinet.cabinet)
    await server.start(HOST, 0)
    yield server
    await server.stop()


async def samples_of(arm: AuboArcs, seconds: float) -> list[PoseSample]:
    samples: list[PoseSample] = []
    arm.listen(samples.append)
    await asyncio.sleep(seconds)
    arm.listen(None)
    return samples


async def test_poses_are_pushed_at_the_frequency_that_was_asked_for(
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str], cabinet: ArcsServer
):
    arm = make_arm(rtde_port=rtde.port)
    identity = await arm.connect()
    assert identity.firmware == "interface 24000, telemetry by RTDE"
    await arm.enable()
    samples = await samples_of(arm, 0.5)
    assert 40 <= len(samples) <= 60
    assert all(a.stamp.seq + 1 == b.stamp.seq for a, b in itertools.pairwise(samples))
    assert all(a.stamp.host_ns <= b.stamp.host_ns for a, b in itertools.pairwise(samples))
    await arm.move(brush_pose(300.0, -200.0, 240.0), speed_mm_s=200.0, acc_mm_s2=800.0)
    await asyncio.sleep(0.05)
    assert distance(arm.latest().pose, cabinet.cabinet.world.tool())[0] < 0.01
    assert not notices
    await arm.close()
    await until(lambda: rtde.clients == 0, "the subscription to end")


@pytest.mark.parametrize("late_s", [0.0, 0.8])
async def test_the_lag_of_pushed_poses_is_measured_while_the_arm_moves(
    rtde: RtdeServer, make_arm: MakeArm, late_s: float
):
    arm = make_arm(rtde_port=rtde.port)
    await arm.connect()
    await arm.enable()
    assert arm.pose_lag_ms() is None
    if late_s:
        rtde.faults.hang(Fault(device=Device.TELEMETRY, kind="late", late_s=late_s, count=ALWAYS))
        await asyncio.sleep(late_s)
    down, up = (QueuedLine(brush_pose(250.0, -230.0, z_mm), 4.0) for z_mm in (220.0, 259.0))
    await arm.sequence([down, up], acc_mm_s2=800.0)
    assert arm.pose_lag_ms() == pytest.approx(1e3 * late_s, abs=60.0)


async def test_a_port_that_is_closed_or_silent_is_reported_and_poses_are_polled(
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str], unused_tcp_port: int
):
    mute(rtde)
    for port in (unused_tcp_port, rtde.port):
        arm = make_arm(rtde_port=port)
        assert (await arm.connect()).firmware == "interface 24000, telemetry by polling"
        assert len(await samples_of(arm, 0.2)) >= 3
    assert len(notices) == 2
    assert "polled instead of pushed: no sample" in notices[1]


async def test_a_silence_that_ends_is_bridged_by_asking(rtde: RtdeServer, make_arm: MakeArm, notices: list[str]):
    arm = make_arm(rtde_port=rtde.port)
    await arm.connect()
    mute(rtde)
    await asyncio.sleep(0.7)
    assert arm.latest()
    rtde.faults.clear()
    await asyncio.sleep(0.1)
    assert len(await samples_of(arm, 0.2)) >= 3
    assert not notices
    assert arm._telemetry.source == "RTDE"


@pytest.mark.parametrize("fault", ["mute", "hang up"])
async def test_a_stream_that_ends_later_is_reported_and_poses_go_on(
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str], fault: str
):
    arm = make_arm(rtde_port=rtde.port)
    await arm.connect()
    if fault == "mute":
        mute(rtde)
    else:
        rtde.drop_clients()
    await asyncio.sleep(3.0)
    assert len(await samples_of(arm, 0.2)) >= 10
    assert len(notices) == 1
    assert arm._telemetry.source == "polling"


async def test_where_both_ways_are_silent_the_pose_goes_stale(rtde: RtdeServer, make_arm: MakeArm, cabinet: ArcsServer):
    arm = make_arm(rtde_port=rtde.port)
    await arm.connect()
    mute(rtde)
    mute(cabinet)
    await asyncio.sleep(0.7)
    with pytest.raises(Stale):
        arm.latest()
    cabinet.faults.clear()


async def test_a_pose_that_is_none_ends_the_stream_not_the_arm(rtde: RtdeServer, make_arm: MakeArm, notices: list[str]):
    rtde._outputs["R1_actual_TCP_pose"] = (1021, lambda: [None] * 6)
    arm = make_arm(rtde_port=rtde.port)
    assert (await arm.connect()).firmware.endswith("polling")
    assert len(notices) == 1
    arm.latest()


Path = Callable[[float], Pose]


def press(t_s: float) -> Pose:
    """20 mm down at 20 mm/s, half a second of dwell, and the same way up."""
    depth_mm = 20.0 * min(max(t_s, 0.0), 1.0, max(2.5 - t_s, 0.0))
    return brush_pose(400.0, 0.0, 140.0 - depth_mm)


def circle(t_s: float) -> Pose:
    return brush_pose(400.0 + 15.0 * math.cos(2.0 * t_s), 15.0 * math.sin(2.0 * t_s), 118.0)


def lag_ms(
    path: Path, lag_s: float, *, answer_s: float = 0.004, silent: tuple[float, float] = (0.0, 0.0), seconds: float = 4.0
) -> float | None:
    """What is measured where poses arrive this late, 100 times a second, and 40 questions a second are answered."""
    clock, rng = SetClock(), random.Random(7)
    meter = LagMeter(clock)
    for tick in range(round((seconds + lag_s) * 100)):
        t_s = 0.01 * tick
        if not silent[0] < t_s < silent[1]:
            meter.arrived(PoseSample(Stamp(round(1e9 * (100.0 + t_s))), path(t_s - lag_s)))
    for tick in range(round(seconds * 40)):
        t_s = tick / 40 + rng.uniform(0.0, 0.01)
        clock.s = 100.0 + t_s + rng.uniform(0.0, answer_s)
        meter.asked(path(t_s), answer_s)
    return meter.lag_ms()


@pytest.mark.parametrize("path", [press, circle])
@pytest.mark.parametrize("lag_s", [0.0, 0.12, 2.0])
def test_the_lag_is_measured_to_a_few_milliseconds(path: Path, lag_s: float):
    assert lag_ms(path, lag_s) == pytest.approx(1e3 * lag_s, abs=15.0)


def test_a_computer_that_was_busy_for_a_while_does_not_count_as_a_lag():
    assert lag_ms(press, 0.0, silent=(0.3, 0.8)) == pytest.approx(0.0, abs=15.0)


def test_from_answers_that_took_long_and_from_an_arm_at_rest_nothing_is_concluded():
    assert lag_ms(press, 0.0, answer_s=0.2) is None
    assert lag_ms(lambda _: brush_pose(400.0, 0.0, 140.0), 0.8) is None


def test_poses_of_another_path_are_not_compared():
    clock = SetClock(100.0)
    meter = LagMeter(clock)
    for tick in range(400):
        clock.s = 100.0 + 0.01 * tick
        meter.arrived(PoseSample(Stamp(clock.now_ns()), brush_pose(400.0, 0.0, 140.0)))
        meter.asked(circle(0.01 * tick), 0.001)
    assert meter.lag_ms() is None
