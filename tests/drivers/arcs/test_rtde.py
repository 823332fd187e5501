"""Telemetry that is pushed, and what happens when it is not."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import cbor2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.arcs import telemetry
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import ArcsOptions
from brushloop.drivers.arcs.telemetry import PING, RtdeStream, decode_message, encode_sample, encode_topic, outputs_of
from brushloop.drivers.arcs.wire import FrameDecoder, encode, encode_short
from brushloop.drivers.devices import PoseSample, QueuedLine
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, ProtocolViolation, Stale
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.host import HostClock
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.arcs.server import ArcsServer, RtdeServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.server import LoopbackServer
from tests.drivers.muting import mute

GREETING = b'{"protocol":"rtde","version":1,"input":{"set_recipe":100},"output":{"R1_actual_TCP_pose":1021}}\n\n'
POSE = ["R1_actual_TCP_pose"]
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
MakeArm = Callable[[int | None], AuboArcs]


def test_a_topic_is_the_one_that_the_makers_client_sends():
    theirs = cbor2.loads(
        b"\x82\x18d\xa5fchanel\x00ifrequency\xfaBH\x00\x00hsegments\x82kR1_actual_qrR1_actual_TCP_poseito_server\xf4gtrigger\x1aAAAA"
    )
    [ours] = FrameDecoder().feed(encode_topic(0, ["R1_actual_q", "R1_actual_TCP_pose"], 50.0))
    command, topic = cbor2.loads(ours)
    assert (command, {**topic, "trigger": 0x41414141}) == (100, theirs[1])
    assert type(topic["frequency"]) is float


@pytest.mark.parametrize("payload", [cbor2.dumps([0, [1.0, 2.0], "Running"]), b'[0, [1.0, 2.0], "Running"]'])
def test_cbor_and_json_are_both_understood(payload: bytes):
    assert decode_message(payload, "rtde") == (0, [[1.0, 2.0], "Running"])


nested = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=3), v, max_size=3),
    max_leaves=8,
)


@settings(deadline=None)
@given(st.integers(0, 2**31), st.lists(nested, max_size=4), st.data())
def test_samples_decode_to_themselves_wherever_they_are_cut_and_whatever_pings_stand_between(
    head: int, values: list[Any], data: st.DataObject
):
    stream = PING + encode_sample(head, values) + PING + PING + encode_sample(head, []) + PING
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    decoder = FrameDecoder(skip=PING)
    edges = zip([0, *cuts], [*cuts, len(stream)], strict=True)
    got = [decode_message(p, "rtde") for a, b in edges for p in decoder.feed(stream[a:b])]
    assert got == [(head, values), (head, [])]


@settings(deadline=None)
@given(st.one_of(st.binary(max_size=60), nested.map(cbor2.dumps)))
def test_any_payload_is_a_message_or_a_protocol_violation(payload: bytes):
    with contextlib.suppress(ProtocolViolation):
        head, values = decode_message(payload, "rtde")
        assert isinstance(head, int)
        assert isinstance(values, list)


HOSTILE = [
    b"\x81" * 60_000 + b"\x00",
    b"[" * 60_000,
    b"\x9b\xff\xff\xff\xff\xff\xff\xff\xff",
    b"\x5b\x00\x00\x00\x01\x00\x00\x00\x00",
    b"\xd8\x23\x62((",
    b"\xd8\x1e\x82\x01\x00",
    b"",
    b"\x80",
    b"\x81\xf4",
    b"\x00",
]


@pytest.mark.parametrize("payload", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_payloads_are_refused(payload: bytes):
    with pytest.raises(ProtocolViolation):
        decode_message(payload, "rtde")


@settings(deadline=None)
@given(st.one_of(st.binary(max_size=60), nested.map(lambda v: json.dumps(v).encode())))
def test_any_greeting_gives_names_or_a_protocol_violation(greeting: bytes):
    with contextlib.suppress(ProtocolViolation):
        assert isinstance(outputs_of(greeting, "rtde"), dict)


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


def says(*pieces: bytes, hold_s: float = 0.3) -> Serve:
    async def script(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for piece in pieces:
            writer.write(piece)
            await writer.drain()
            await asyncio.sleep(0.01)
        await asyncio.sleep(hold_s)

    return script


async def outcome(port: int) -> list[Any]:
    stream = RtdeStream(HOST, port, timeout_s=0.15)
    try:
        await stream.open(POSE, 50.0)
        return await stream.newest()
    finally:
        await stream.close()


LONG_FRAME = b"SOF\x01\x7f\xff\xff\xff"


@pytest.mark.parametrize(
    ("script", "error"),
    [
        (says(hold_s=0.3), DeviceTimeout),
        (says(GREETING[:30], hold_s=0.3), DeviceTimeout),
        (says(hold_s=0.0), ConnectionLost),
        (says(b"hello }\n\n"), ProtocolViolation),
        (says(GREETING.replace(b"R1_actual_TCP_pose", b"R1_other")), ProtocolViolation),
        (says(*[b"x" * 65536] * 10), ProtocolViolation),
        (says(GREETING), DeviceTimeout),
        (says(GREETING, hold_s=0.0), ConnectionLost),
        (says(GREETING, b"garbage"), ProtocolViolation),
        (says(GREETING, LONG_FRAME), ProtocolViolation),
        (says(GREETING, encode_short(b"\xff")), ProtocolViolation),
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


async def test_a_stream_that_is_not_open_says_so():
    with pytest.raises(NotConnected):
        await RtdeStream(HOST, 1).newest()


@pytest.fixture
async def rtde(cabinet: ArcsServer) -> AsyncIterator[RtdeServer]:
    server = RtdeServer(cabinet.cabinet)
    await server.start(HOST, 0)
    yield server
    await server.stop()


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
async def make_arm(cabinet: ArcsServer, limits: Limits, notices: list[str]) -> AsyncIterator[MakeArm]:
    arms: list[AuboArcs] = []

    def make(rtde_port: int | None) -> AuboArcs:
        options = ArcsOptions(HOST, cabinet.port, (0.0, 0.0, 180.0), power_timeout_s=5.0, rtde_port=rtde_port)
        arms.append(AuboArcs(options, limits, HostClock(), notices.append))
        return arms[-1]

    yield make
    for arm in arms:
        await arm.close()


async def samples_of(arm: AuboArcs, seconds: float) -> list[PoseSample]:
    samples: list[PoseSample] = []
    arm.listen(samples.append)
    await asyncio.sleep(seconds)
    arm.listen(None)
    return samples


async def test_poses_are_pushed_at_the_frequency_that_was_asked_for(
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str], cabinet: ArcsServer
):
    arm = make_arm(rtde.port)
    identity = await arm.connect()
    assert identity.firmware == "interface 24000, telemetry by RTDE"
    await arm.enable()
    samples = await samples_of(arm, 0.5)
    assert 20 <= len(samples) <= 60
    assert all(a.stamp.seq + 1 == b.stamp.seq for a, b in itertools.pairwise(samples))
    assert all(a.stamp.host_ns <= b.stamp.host_ns for a, b in itertools.pairwise(samples))
    await arm.move(brush_pose(300.0, -200.0, 240.0), speed_mm_s=200.0, acc_mm_s2=800.0)
    await asyncio.sleep(0.05)
    assert distance(arm.latest().pose, cabinet.cabinet.world.tool())[0] < 0.01
    assert not notices
    await arm.close()
    await asyncio.sleep(0.02)
    assert rtde.clients == 0


@pytest.mark.parametrize("late_s", [0.0, 0.8])
async def test_the_lag_of_pushed_poses_is_measured_while_the_arm_moves(
    rtde: RtdeServer, make_arm: MakeArm, late_s: float
):
    arm = make_arm(rtde.port)
    await arm.connect()
    await arm.enable()
    assert arm.pose_lag_ms() is None
    if late_s:
        rtde.faults.hang(Fault(device=Device.TELEMETRY, kind="late", late_s=late_s, count=ALWAYS))
        await asyncio.sleep(late_s)
    down, up = (QueuedLine(brush_pose(250.0, -230.0, z_mm), 4.0) for z_mm in (220.0, 259.0))
    await arm.sequence([down, up], acc_mm_s2=800.0)
    assert arm.pose_lag_ms() == pytest.approx(1e3 * late_s, abs=60.0)


async def test_a_closed_port_is_reported_and_poses_are_polled(
    make_arm: MakeArm, notices: list[str], unused_tcp_port: int
):
    arm = make_arm(unused_tcp_port)
    assert (await arm.connect()).firmware == "interface 24000, telemetry by polling"
    assert len(await samples_of(arm, 0.2)) >= 3
    assert len(notices) == 1
    assert "polled" in notices[0]


async def test_a_port_that_is_silent_from_the_start_is_not_fatal(
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str]
):
    mute(rtde)
    arm = make_arm(rtde.port)
    assert (await arm.connect()).firmware.endswith("polling")
    assert len(await samples_of(arm, 0.2)) >= 3
    assert "no sample" in notices[0]


async def test_a_silence_that_ends_is_bridged_by_asking(rtde: RtdeServer, make_arm: MakeArm, notices: list[str]):
    arm = make_arm(rtde.port)
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
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str], fault: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(telemetry, "MOST_SILENCES", 0)
    arm = make_arm(rtde.port)
    await arm.connect()
    if fault == "mute":
        mute(rtde)
    else:
        rtde.drop_clients()
    await asyncio.sleep(0.8)
    assert len(await samples_of(arm, 0.2)) >= 3
    assert len(notices) == 1
    arm.latest()


async def test_where_both_ways_are_silent_the_pose_goes_stale(rtde: RtdeServer, make_arm: MakeArm, cabinet: ArcsServer):
    arm = make_arm(rtde.port)
    await arm.connect()
    mute(rtde)
    mute(cabinet)
    await asyncio.sleep(0.7)
    with pytest.raises(Stale):
        arm.latest()
    cabinet.faults.clear()


@pytest.mark.parametrize("pose", [[1.0, 2.0], "here", [None] * 6, [1e999] * 6, 5])
async def test_a_pose_that_is_none_ends_the_stream_not_the_arm(
    rtde: RtdeServer, make_arm: MakeArm, notices: list[str], pose: object
):
    rtde._outputs["R1_actual_TCP_pose"] = (1021, lambda: pose)
    arm = make_arm(rtde.port)
    assert (await arm.connect()).firmware.endswith("polling")
    assert len(notices) == 1
    arm.latest()
