"""A loopback cabinet and an arm on it, quick enough for every test."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

import pytest

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.world import SimClock, World
from tests.simulated_time import LoopClock

RATE = 20.0


@pytest.fixture
def small_view() -> View:
    """A camera image that renders in a few milliseconds."""
    return View(width_px=640, height_px=480, px_per_mm=1.95)


@pytest.fixture
def limits() -> Limits:
    return Limits((200.0, 640.0), (-260.0, 260.0), (95.0, 400.0), tilt_deg=15.0, speed_mm_s=250.0, acc_mm_s2=1000.0)


@pytest.fixture
async def cabinet() -> AsyncIterator[ArcsServer]:
    """A controller with its power off, 20 times faster than life."""
    clock = SimClock(RATE, asyncio.get_running_loop().time)
    server = ArcsServer(World(SimConfig(rate=RATE), clock))
    await server.start(HOST, 0)
    yield server
    await server.stop()


@pytest.fixture
def arm_at(limits: Limits) -> Callable[[int], AuboArcs]:
    """An arm that is not connected yet, by the port of its controller."""

    def make(port: int) -> AuboArcs:
        options = ArcsTable(kind="aubo-arcs", host=HOST, port=port, tcp_offset_mm=(0.0, 0.0, 180.0))
        return AuboArcs(options, limits, LoopClock())

    return make


@pytest.fixture
async def sleeping_arm(cabinet: ArcsServer, arm_at: Callable[[int], AuboArcs]) -> AsyncIterator[AuboArcs]:
    """Connected, powered off."""
    arm = arm_at(cabinet.port)
    await arm.connect()
    yield arm
    await arm.close()


@pytest.fixture
async def arm(sleeping_arm: AuboArcs) -> AuboArcs:
    """Connected, powered, brakes released."""
    await sleeping_arm.enable()
    return sleeping_arm
