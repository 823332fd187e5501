"""Every archive of `brushloop doctor --report` in the folder `reports` is a test: put a lab's there.

The driver must read its controller as it did in the lab: the same words, and what it makes of them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.drivers.arcs.robot import ArcsOptions, AuboArcs
from brushloop.drivers.arcs.survey import survey
from brushloop.drivers.host import HostClock
from brushloop.drivers.limits import Limits
from tests.drivers.arcs.transcript import AnsweringByName, Archive, following, serving

REPORTS = sorted((Path(__file__).parent / "reports").glob("*.zip"))
NOWHERE = Limits((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 1.0, 1.0, 1.0)


@pytest.fixture(params=REPORTS, ids=lambda path: path.stem)
def archive(request: pytest.FixtureRequest) -> Archive:
    return Archive.read(request.param)


async def test_the_same_questions_get_the_same_answers(archive: Archive) -> None:
    async with following(archive.script(), archive.framing) as controller:
        exchanges = await survey("127.0.0.1", controller.port, archive.framing)
    assert [(e.method, e.params) for e in exchanges] == [(line["method"], line["params"]) for line in archive.lines]
    for exchange, line in zip(exchanges, archive.lines, strict=True):
        assert exchange.answer.keys() == line["answer"].keys(), exchange.method
        assert exchange.answer.get("result") == line["answer"].get("result"), exchange.method


async def test_the_driver_finds_what_the_doctor_found(archive: Archive) -> None:
    if not archive.robot["answers"]:
        pytest.skip("the driver could not connect to this cabinet")
    controller = AnsweringByName(archive)
    async with serving(controller):
        options = ArcsOptions("127.0.0.1", controller.port, (0.0, 0.0, 0.0), framing=archive.framing)
        arm = AuboArcs(options, NOWHERE, HostClock())
        identity = await arm.connect()
        state = await arm.state(1)
        await arm.close()
    assert identity.model == archive.robot["identity"]
    assert archive.robot["firmware"].startswith(identity.firmware)
    assert f"{state.mode}, safety {state.safety}" in archive.robot["notes"]
