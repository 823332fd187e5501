"""Transcripts: what the client must send, what the controller answers, what the caller gets.

Every archive of `brushloop doctor --report` in the folder `reports` is a test too: put a lab's there.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from brushloop.drivers.arcs.controller import survey
from brushloop.drivers.arcs.wire import Framing, RpcConnection, encode
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, ProtocolViolation, RpcError
from brushloop.drivers.sim.rig import HOST
from tests.drivers.arcs.conftest import Cabinet
from tests.drivers.arcs.transcript import (
    Answer,
    Archive,
    Controller,
    following,
    hang_up,
    nothing,
    reply,
    result,
    sends,
)
from tests.drivers.failing import mute_to

REPORTS = sorted((Path(__file__).parent / "reports").glob("*.zip"))


@pytest.fixture
async def controller() -> AsyncIterator[Controller]:
    async with following([]) as it:
        yield it


@pytest.fixture
async def client(controller: Controller) -> AsyncIterator[RpcConnection]:
    connection = RpcConnection("127.0.0.1", controller.port)
    await connection.open()
    yield connection
    await connection.close()


async def test_callers_at_the_same_time_take_turns_with_ids_of_the_vendors_shape_that_never_repeat(
    controller: Controller, client: RpcConnection
):
    methods = [f"method{number}" for number in range(20)]
    controller.script = [(method, None, sends(lambda i: reply(i, result=i), 0.02)) for method in methods]
    answers = await asyncio.gather(*(client.call(method) for method in methods))
    assert answers == controller.ids
    assert all(re.fullmatch(r"[A-Za-z0-9]{8}-[A-Za-z0-9]{4}-[A-Za-z0-9]{4}", ident) for ident in controller.ids)
    assert len(set(controller.ids)) == 20


async def test_a_late_reply_to_an_old_call_is_dropped(controller: Controller, client: RpcConnection):
    controller.script = [
        ("first", None, nothing),
        ("second", None, sends(lambda i: reply(controller.ids[0], result="late") + reply(i, result="mine"))),
    ]
    with pytest.raises(DeviceTimeout):
        await client.call("first")
    assert await client.call("second") == "mine"


@pytest.mark.parametrize(
    "answer",
    [
        pytest.param(sends(lambda _: reply("AAAAAAAA-BBBB-CCCC", result=0)), id="another id"),
        pytest.param(sends(lambda _: reply(7, result=0)), id="an integer id"),
        pytest.param(sends(lambda _: encode(b"[1, 2]")), id="no object"),
        pytest.param(nothing, id="silence"),
    ],
)
async def test_what_does_not_answer_the_call_is_waited_out(
    controller: Controller, client: RpcConnection, answer: Answer
):
    controller.script = [("getRobotNames", None, answer)]
    with pytest.raises(DeviceTimeout, match="getRobotNames"):
        await client.call("getRobotNames")


@pytest.mark.parametrize(
    "answer",
    [
        pytest.param(sends(lambda _: encode(b"hello")), id="no JSON"),
        pytest.param(sends(lambda _: encode(b"[" * 100_000)), id="nested without end"),
        pytest.param(sends(lambda i: reply(i)), id="neither result nor error"),
        pytest.param(sends(lambda i: reply(i, error="bad")), id="an error that is no object"),
    ],
)
async def test_a_reply_that_makes_no_sense_is_a_violation_and_the_next_call_works(
    controller: Controller, client: RpcConnection, answer: Answer
):
    controller.script = [("first", None, answer), ("second", None, result(2))]
    with pytest.raises(ProtocolViolation):
        await client.call("first")
    assert await client.call("second") == 2


async def test_when_the_controller_hangs_up_all_calls_fail_until_the_connection_is_opened_again(
    controller: Controller, client: RpcConnection
):
    controller.script = [("first", None, hang_up), ("third", None, result(3))]
    with pytest.raises(ConnectionLost, match="first"):
        await client.call("first")
    with pytest.raises(ConnectionLost, match="second"):
        await client.call("second")
    assert client.lost
    await client.close()
    await client.open()
    assert await client.call("third") == 3


async def test_closing_wakes_the_caller_that_still_waits(controller: Controller, client: RpcConnection):
    controller.script = [("first", None, nothing)]
    waiting = asyncio.create_task(client.call("first"))
    await asyncio.sleep(0.02)
    await client.close()
    with pytest.raises(NotConnected, match="closed while waiting"):
        await waiting


STOP_LINE, MOVE_LINE = "rob1.MotionControl.stopLine", "rob1.MotionControl.moveLine"
PACE = {"a": 1.0, "v": 1.0, "blend_radius": 0.0, "duration": 0.0}
NONSENSE: list[tuple[str, dict[str, object], int]] = [
    ("Nonsense", {}, -32601),
    (STOP_LINE, {"acc": "fast", "acc_rot": 1.0}, -32602),
    (MOVE_LINE, {"pose": [1], **PACE}, -32602),
    ("rob1.RobotAlgorithm.forwardKinematics", {"q": [math.inf] * 6}, -32602),
]


@pytest.mark.parametrize("framing", ["sof", "bare"])
async def test_the_loopback_controller_answers_nonsense_with_the_codes_of_json_rpc(cabinet: Cabinet, framing: Framing):
    connection = RpcConnection(HOST, cabinet.port, framing=framing)
    await connection.open()
    for method, params, code in NONSENSE:
        with pytest.raises(RpcError, match=re.escape(f"{method}: controller answered error {code}")) as caught:
            await connection.call(method, params)
        assert caught.value.code == code
    assert await connection.call("getRobotNames") == ["rob1"]
    await connection.close()


@pytest.mark.parametrize(("sent", "answer"), [(b"[1]", b"-32600"), (b"SOF\x00\x00\x09__login__", b"SUCCEED")])
async def test_what_is_no_request_gets_an_error_and_a_frame_may_be_short(cabinet: Cabinet, sent: bytes, answer: bytes):
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    writer.write(sent)
    assert answer in await reader.read(4096)
    writer.close()
    await writer.wait_closed()


# ---------------------------------------------------------------- reports of labs


async def test_a_cabinet_that_does_not_answer_the_login_is_asked_all_the_same(cabinet: Cabinet) -> None:
    mute_to(cabinet, "login")
    refused, first, *_ = await survey(HOST, cabinet.port, "sof")
    assert refused["answer"] == {"silence": "no reply in 1 s"}
    assert (first["method"], first["answer"]) == ("SystemInfo.getInterfaceVersionCode", {"result": 24000})


@pytest.mark.parametrize("path", REPORTS, ids=lambda path: path.stem)
async def test_the_same_questions_get_the_same_answers(path: Path) -> None:
    archive = Archive(path)
    async with following(archive.script(), archive.framing) as controller:
        exchanges = await survey("127.0.0.1", controller.port, archive.framing)
    for exchange, line in zip(exchanges, archive.lines, strict=True):
        assert (exchange["method"], exchange["params"]) == (line["method"], line["params"])
        assert exchange["answer"].keys() == line["answer"].keys(), line["method"]
        assert exchange["answer"].get("result") == line["answer"].get("result"), line["method"]
