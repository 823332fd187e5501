"""One connection to the controller: calls, what answers them, and what is said when nothing does.

Every archive of `brushloop doctor --report` in the folder `reports` is a test too: put a lab's there.
"""

from __future__ import annotations

import asyncio
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest

from brushloop.collect.rig.doctor import survey
from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.wire import Framing, answer_in
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, ProtocolViolation
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Device, Fault
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.world import World
from tests.drivers.arcs.conftest import Cabinet, mute_to

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
