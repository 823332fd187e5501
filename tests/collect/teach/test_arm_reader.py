"""What a cabinet says about itself is checked before it is kept: it may be any firmware, or no cabinet at all."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from brushloop.collect.teach.arm_reader import Address, Cabinet, reading
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.steps.arm import ArmStep
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World


async def cabinet_that_answers(getter: str, answer: object) -> Cabinet:
    server = ArcsServer(World(SimConfig()))
    server._methods[f"rob1.RobotConfig.{getter}"] = lambda _: answer
    await server.start("127.0.0.1", 0)
    try:
        async with reading(Address("127.0.0.1", server.port), "sof") as reader:
            return await reader.cabinet("sof")
    finally:
        await server.stop()


@pytest.mark.parametrize("port", ["x", "0", "65536", "-1", "9" * 5000])
def test_a_port_is_a_number_in_the_range_of_ports(port: str) -> None:
    with pytest.raises(ValueError, match="is not a number from 1 to 65535"):
        Address.of(f"192.0.2.7:{port}")


@pytest.mark.parametrize(
    ("getter", "answer"),
    [
        ("getPayload", [math.nan, [0.0, 0.0, 0.0]]),
        ("getPayload", ["1.5", [0.0, 0.0, 0.0]]),
        ("getCollisionLevel", None),
        ("getTcpOffset", [0.0, 0.0, math.inf, 0.0, 0.0, 0.0]),
    ],
)
async def test_an_answer_that_is_no_number_is_refused_by_its_getter(getter: str, answer: object) -> None:
    with pytest.raises(ProtocolViolation, match=getter):
        await cabinet_that_answers(getter, answer)


async def test_a_long_name_is_cut_to_what_the_notebook_has_room_for(tmp_path: Path) -> None:
    cabinet = await cabinet_that_answers("getRobotType", 1000 * "i5")
    day = Day(None, tmp_path / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    ArmStep()._keep(day, Address("192.0.2.7"), cabinet, None)
    assert str(day.notebook.values["robot.kind"].how).startswith("i5i5i5")
