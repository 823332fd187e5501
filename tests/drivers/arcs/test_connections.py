"""The connections to the controller: calls and what answers them, samples that are pushed or polled, and their lag.

Every archive of `brushloop doctor --report` in the folder `reports` is a test too: put a lab's there.
"""

from __future__ import annotations

import asyncio
import json
import math
import random
import re
import zipfile
from collections.abc import AsyncIterator, Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cbor2
import pytest

from brushloop.collect.rig.doctor import survey
from brushloop.drivers.arcs import telemetry
from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.telemetry import LagMeter, RtdeStream, encode_sample, encode_topic
from brushloop.drivers.arcs.wire import PING, Decoder, Framing, answer_in, encode
from brushloop.drivers.devices import Pose, PoseSample, QueuedLine, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, ProtocolViolation, Stale
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer, topic_of
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.world import World
from tests.drivers.arcs.conftest import NEAR, QUICK, Cabinet, MakeArm, mute, mute_to
from tests.simulated_time import SimulatedTime
from tests.waiting import until

REPORTS = sorted((Path(__file__).parent / "reports").glob("*.zip"))
MODE, SAFETY = "rob1.RobotState.getRobotModeType", "rob1.RobotState.getSafetyModeType"


async def test_callers_at_the_same_time_take_turns_with_ids_of_the_vendors_shape_that_never_repeat(
    cabinet: Cabinet, other: Controller
):
    requests: list[dict[str, Any]] = []
    answer = cabinet._answer
    cabinet._answer = lambda request: (requests.append(request), answer(request))[1]  # type: ignore[method-assign]
    answers = await asyncio.gather(*[other.call(method) for method in (MODE, SAFETY) * 10])
    assert answers == ["PowerOff", "Normal"] * 10
    assert [request["method"] for request in requests] == [MODE, SAFETY] * 10
    idents = [request["id"] for request in requests]
    assert all(re.fullmatch(r"[A-Za-z0-9]{8}-[A-Za-z0-9]{4}-[A-Za-z0-9]{4}", ident) for ident in idents)
    assert len(set(idents)) == 20


@pytest.mark.parametrize(
    ("kind", "error"),
    [
        ("mute", DeviceTimeout),
        ("late", DeviceTimeout),
        ("wrong-id", DeviceTimeout),
        ("malformed", ProtocolViolation),
        ("garbage", ConnectionLost),
        ("drop", ConnectionLost),
    ],
)
async def test_a_call_without_a_good_answer_fails_and_calls_work_again_on_a_connection_that_is_whole_or_opened_again(
    cabinet: Cabinet, other: Controller, kind: str, error: type[Exception]
):
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind=kind, on="getRobotModeType", late_s=1.5))
    with pytest.raises(error, match="getRobotModeType"):
        await other.call(MODE)
    assert other.lost is (error is ConnectionLost)
    if other.lost:
        with pytest.raises(ConnectionLost, match="getSafetyModeType"):
            await other.call(SAFETY)
        await other.open()
    await asyncio.sleep(1.0)  # the late reply is there before the next one
    assert await other.call(SAFETY) == "Normal"


@pytest.mark.parametrize("reply", [b"hello", b"[" * 100_000, b'{"id": 1}', b'{"id": 1, "error": "bad"}'])
def test_a_reply_that_makes_no_sense_is_a_violation_and_one_with_another_id_is_none(reply: bytes):
    with pytest.raises(ProtocolViolation):
        answer_in(reply, 1, "getRobotNames")
    for other in (b"[1, 2]", b'{"id": 7, "result": 0}', b'{"id": true, "result": 0}', b'{"result": 0}'):
        assert answer_in(other, 1, "getRobotNames") is None


async def test_closing_wakes_the_caller_that_still_waits(cabinet: Cabinet, other: Controller):
    mute_to(cabinet, "getRobotModeType")
    waiting = asyncio.create_task(other.call(MODE))
    await asyncio.sleep(0.02)
    await other.close()
    with pytest.raises(NotConnected, match="closed while waiting"):
        await waiting


async def test_a_cabinet_that_does_not_answer_the_login_is_asked_all_the_same(cabinet: Cabinet) -> None:
    mute_to(cabinet, "login")
    refused, first, *_ = await survey(HOST, cabinet.port, "sof")
    assert refused["answer"] == {"silence": "no reply in 1 s"}
    assert (first["method"], first["answer"]) == ("SystemInfo.getInterfaceVersionCode", {"result": 24000})


class Replayed(ArcsServer):
    """Gives the answers of what `brushloop doctor --report` wrote, in their order, whatever is asked."""

    def __init__(self, report: Path) -> None:
        super().__init__(World(SimConfig()))
        with zipfile.ZipFile(report) as archive:
            self.framing: Framing = json.loads(archive.read("report.json"))["framing"]
            self.lines: list[dict[str, Any]] = [json.loads(line) for line in archive.read("arcs.jsonl").splitlines()]
            """Each has method, params and answer."""
        self._left = [line["answer"] for line in self.lines]

    def _answer(self, request: dict[str, Any]) -> bytes:
        answer = self._left.pop(0)
        if "silence" in answer or "lost" in answer:
            self.faults.hang(Fault(device=Device.ROBOT, kind="mute" if "silence" in answer else "drop"))
        body = {key: value for key, value in answer.items() if key in ("result", "error")}  # of `refused`: neither
        return json.dumps({"id": request["id"], "jsonrpc": "2.0", **body}).encode()


@pytest.mark.parametrize("path", REPORTS, ids=lambda path: path.stem)
async def test_the_same_questions_get_the_same_answers(path: Path) -> None:
    controller = Replayed(path)
    await controller.start(HOST, 0)
    exchanges = await survey(HOST, controller.port, controller.framing)
    await controller.stop()
    for exchange, line in zip(exchanges, controller.lines, strict=True):
        assert (exchange["method"], exchange["params"]) == (line["method"], line["params"])
        assert exchange["answer"].keys() == line["answer"].keys(), line["method"]
        assert exchange["answer"].get("result") == line["answer"].get("result"), line["method"]


# ---------------------------------------------------------------- what is pushed, and what is polled

GREETING = b'{"protocol":"rtde","version":1,"output":{"R1_actual_TCP_pose":1021,"R1_actual_q":1006}}\n\n'
MAKERS_TOPIC = (
    b"\x82\x18d\xa5fchanel\x00ifrequency\xfaBH\x00\x00hsegments\x82kR1_actual_qrR1_actual_TCP_pose"
    b"ito_server\xf4gtrigger\x1aAAAA"
)


def test_a_topic_is_the_one_that_the_makers_client_sends_and_is_understood():
    names = ["R1_actual_q", "R1_actual_TCP_pose"]
    [payload] = Decoder().feed(encode_topic(0, names, 50.0))
    command, topic = cbor2.loads(payload)
    assert [command, {**topic, "trigger": 0x41414141}] == cbor2.loads(MAKERS_TOPIC)
    assert type(topic["frequency"]) is float
    assert topic_of(MAKERS_TOPIC) == (0, 50.0, names)


HANGS_UP = b""


async def newest(*said: bytes) -> list[Any]:
    """The newest sample of a controller that says this, and then is silent or hangs up."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for piece in said:
            writer.write(piece)
            await asyncio.sleep(0.01)
        if HANGS_UP not in said:
            await reader.read()
        writer.close()

    async with await asyncio.start_server(serve, HOST, 0) as server:
        stream = RtdeStream(HOST, server.sockets[0].getsockname()[1])
        try:
            await stream.open()
            return (await stream.samples())[-1]
        finally:
            await stream.close()
            await asyncio.sleep(0.1)  # for the controller


@pytest.mark.parametrize(
    ("said", "sample"),
    [
        ([], DeviceTimeout),
        ([GREETING[:30]], DeviceTimeout),
        ([HANGS_UP], ConnectionLost),
        ([GREETING.replace(b"R1_actual_TCP_pose", b"R1_other")], ProtocolViolation),
        ([b"x" * 65536] * 10, ProtocolViolation),
        ([GREETING], DeviceTimeout),
        ([GREETING, HANGS_UP], ConnectionLost),
        ([GREETING, b"SOF\x01\x7f\xff\xff\xff"], ProtocolViolation),
        ([GREETING, encode_sample(0, [])], ProtocolViolation),
        ([GREETING, encode_sample(7, [1])], DeviceTimeout),
        ([GREETING, encode_sample(0, [[1, 2], 3])], [[1, 2], 3]),
        ([GREETING, encode(b"[0,[1,2],3]")], [[1, 2], 3]),
        ([GREETING, PING + encode_sample(0, [1, 2])], [1, 2]),
        ([GREETING, b"".join(encode_sample(0, [k, k]) for k in range(100))], [99, 99]),
    ],
)
async def test_the_newest_sample_is_handed_over_and_what_is_no_telemetry_is_distinguished(
    said: list[bytes], sample: list[Any] | type[Exception]
):
    with pytest.raises(sample) if isinstance(sample, type) else nullcontext():
        assert await newest(*said) == sample


@pytest.fixture
async def rtde(cabinet: Cabinet) -> AsyncIterator[RtdeServer]:
    server = RtdeServer(cabinet)
    await server.start(HOST, 0)
    yield server
    await server.stop()


@pytest.fixture
async def pushed(rtde: RtdeServer, make_arm: MakeArm) -> AuboArcs:
    """Connected, and poses are pushed."""
    arm = make_arm(rtde_port=rtde.port)
    assert (await arm.connect()).firmware == "interface 24000, telemetry by RTDE"
    return arm


async def samples_of(arm: AuboArcs, seconds: float) -> list[PoseSample]:
    samples: list[PoseSample] = []
    arm.listen(samples.append)
    await asyncio.sleep(seconds)
    arm.listen(None)
    return samples


async def test_poses_are_pushed_at_the_frequency_that_was_asked_for(
    rtde: RtdeServer, pushed: AuboArcs, notices: list[str], cabinet: Cabinet
):
    await pushed.enable()
    assert 40 <= len(await samples_of(pushed, 0.5)) <= 60
    await pushed.follow([NEAR], **QUICK)
    await asyncio.sleep(0.05)
    assert distance(pushed.latest().pose, cabinet.tool)[0] < 0.01
    assert not notices
    await pushed.close()
    await until(lambda: rtde.clients == 0, "the subscription to end")


@pytest.mark.parametrize("late_s", [0.0, 0.8])
async def test_the_lag_of_pushed_poses_is_measured_while_the_arm_moves(
    rtde: RtdeServer, pushed: AuboArcs, late_s: float
):
    await pushed.enable()
    assert pushed.pose_lag_ms() is None
    if late_s:
        rtde.faults.hang(Fault(device=Device.TELEMETRY, kind="late", late_s=late_s, count=ALWAYS))
        await asyncio.sleep(late_s)
    down, up = (QueuedLine(brush_pose(250.0, -230.0, z_mm), 4.0) for z_mm in (220.0, 259.0))
    await pushed.sequence([down, up], acc_mm_s2=800.0)
    assert pushed.pose_lag_ms() == pytest.approx(1e3 * late_s, abs=60.0)


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


@pytest.mark.parametrize(
    ("end", "gives_up"),
    [(mute, False), (mute, True), (RtdeServer.drop_clients, True)],
    ids=["a short silence", "a long silence", "hung up"],
)
async def test_a_short_silence_is_bridged_by_asking_and_after_a_long_one_poses_are_polled_for_good(
    rtde: RtdeServer, pushed: AuboArcs, notices: list[str], end: Callable[[RtdeServer], None], gives_up: bool
):
    end(rtde)
    await asyncio.sleep(3.0 if gives_up else 0.7)
    assert pushed.latest()
    rtde.faults.clear()
    await asyncio.sleep(0.1)
    assert len(await samples_of(pushed, 0.2)) >= 3
    assert len(notices) == gives_up
    assert pushed._telemetry.source == ("polling" if gives_up else "RTDE")


async def test_where_both_ways_are_silent_the_pose_goes_stale(rtde: RtdeServer, pushed: AuboArcs, cabinet: Cabinet):
    mute(rtde)
    mute(cabinet)
    await asyncio.sleep(0.7)
    with pytest.raises(Stale):
        pushed.latest()
    cabinet.faults.clear()
    await asyncio.sleep(1.5)
    pushed.latest()  # fresh again by itself


async def test_where_the_arm_rested_between_two_pushes_is_reported_where_time_runs_fast(
    rtde: RtdeServer, cabinet: Cabinet, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(telemetry, "SEGMENTS", ("R1_actual_TCP_pose", "timestamp"))
    monkeypatch.setattr(telemetry, "RATE_HZ", 10.0)
    stream = RtdeStream(HOST, rtde.port)
    await stream.open()
    await stream.samples()
    motion, now_s = cabinet.cabinet.world.motion, cabinet.cabinet.now_s()
    # The flange moves for a second of the arm's time, which is half of what lies between two pushes.
    for z_mm in (250.0, 260.0):
        motion.add(brush_pose(250.0, -230.0, z_mm), 100.0, 1000.0, now_s)
    pushed = [sample for _ in range(3) for sample in await stream.samples()]
    await stream.close()
    assert 0.43 in [round(pose[2], 6) for pose, _ in pushed]
    assert pushed == sorted(pushed, key=lambda sample: sample[1])


# ---------------------------------------------------------------- the lag

Way = Callable[[float], Pose]
HIGH = brush_pose(400.0, 0.0, 140.0)


def press(t_s: float) -> Pose:
    """20 mm down at 20 mm/s, half a second of dwell, and the same way up."""
    depth_mm = 20.0 * min(max(t_s, 0.0), 1.0, max(2.5 - t_s, 0.0))
    return brush_pose(400.0, 0.0, 140.0 - depth_mm)


def circle(t_s: float) -> Pose:
    return brush_pose(400.0 + 15.0 * math.cos(2.0 * t_s), 15.0 * math.sin(2.0 * t_s), 118.0)


def late(path: Way, lag_s: float) -> Way:
    return lambda t_s: path(t_s - lag_s)


def lag_ms(asked: Way, arrived: Way, answer_s: float = 0.004, silent_s: tuple[float, float] = (0.0, 0.0)) -> Any:
    """What is measured in 6 s in which 100 poses a second arrive, and 40 questions a second are answered."""
    clock, rng = SimulatedTime(), random.Random(7)
    meter = LagMeter(clock)
    for tick in range(600):
        t_s = 0.01 * tick
        if not silent_s[0] < t_s < silent_s[1]:
            meter.arrived(PoseSample(Stamp(round(1e9 * (100.0 + t_s))), arrived(t_s)))
    for tick in range(160):
        t_s = tick / 40 + rng.uniform(0.0, 0.01)
        clock.now_s = 100.0 + t_s + rng.uniform(0.0, answer_s)
        meter.asked(asked(t_s), answer_s)
    return meter.lag_ms()


@pytest.mark.parametrize(
    ("expected_ms", "asked", "arrived", "more"),
    [
        *((1e3 * lag_s, path, late(path, lag_s), {}) for path in (press, circle) for lag_s in (0.0, 0.12, 2.0)),
        (0.0, circle, circle, {"silent_s": (0.3, 0.8)}),
        (None, press, press, {"answer_s": 0.2}),
        (None, lambda _: HIGH, lambda _: HIGH, {}),
        (None, circle, lambda _: HIGH, {}),
    ],
)
def test_the_lag_is_measured_to_a_few_milliseconds_or_not_known(
    expected_ms: float | None, asked: Way, arrived: Way, more: dict[str, Any]
):
    """Not known where answers took long, the arm rested, or the poses are of another path."""
    assert lag_ms(asked, arrived, **more) == (
        expected_ms if expected_ms is None else pytest.approx(expected_ms, abs=15.0)
    )
