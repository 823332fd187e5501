"""Time is simulated here: no test waits, and none depends on how busy the machine is."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.rig import HOST
from tests.simulated_time import LoopClock, SimulatedTimeLoop

MakeArm = Callable[..., AuboArcs]


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"simulated": SimulatedTimeLoop}


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
async def make_arm(cabinet: ArcsServer, limits: Limits, notices: list[str]) -> AsyncIterator[MakeArm]:
    """An arm that is not connected, by fields of its table; its box is as wide as the room."""
    arms: list[AuboArcs] = []
    wide = dataclasses.replace(limits, x_mm=(-2000.0, 2000.0))

    def make(**fields: Any) -> AuboArcs:
        table = {"kind": "aubo-arcs", "host": HOST, "port": cabinet.port, "tcp_offset_mm": (0.0, 0.0, 180.0), **fields}
        arms.append(AuboArcs(ArcsTable.model_validate(table), wide, LoopClock(), notices.append))
        return arms[-1]

    yield make
    for arm in arms:
        await arm.close()


@pytest.fixture
async def other(cabinet: ArcsServer) -> AsyncIterator[Controller]:
    """A second client of the same cabinet."""
    client = Controller(RpcConnection(HOST, cabinet.port))
    client.robot = "rob1"
    await client.connection.open()
    yield client
    await client.connection.close()
