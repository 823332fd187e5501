"""A loopback cabinet and arms on it. Time is simulated: no test waits, and none depends on how busy the machine is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.rig import HOST
from brushloop.drivers.sim.world import SimClock, World
from tests.simulated_time import LoopClock
from tests.simulated_time import pytest_asyncio_loop_factories as pytest_asyncio_loop_factories

RATE = 20.0
LIMITS = Limits(x_mm=(-2000.0, 2000.0), y_mm=(-260.0, 260.0), z_mm=(95.0, 400.0))
MakeArm = Callable[..., AuboArcs]
NEAR = brush_pose(260.0, -220.0, 250.0)
QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}


Ends = pytest.RaisesExc[Exception]
"""How a motion ends: the context manager that `pytest.raises` returns."""


class Cabinet(ArcsServer):
    """The loopback controller, and what tests ask of it."""

    @property
    def tool(self) -> Pose:
        """Where the tip is."""
        return self.cabinet.world.tool()

    @property
    def taken(self) -> int:
        """Number of lines that it has taken."""
        return self.cabinet.world.motion._next_id

    @property
    def queued(self) -> int:
        """Number of lines that it holds."""
        return self.cabinet.motion.size(self.cabinet.now_s())

    @property
    def rests(self) -> bool:
        return self.cabinet.motion.exec_id(self.cabinet.now_s()) == -1

    def passed(self) -> list[Pose]:
        """Where the tip is from here on whenever its path bends, begins or ends; grows as it moves."""
        poses: list[Pose] = []
        motion = self.cabinet.world.motion
        on_path = motion._on_path
        motion._on_path = lambda start, end: (poses.extend((start, end)), on_path(start, end))[1]
        return poses

    def answers(self, method: str, answer: object) -> None:
        """Give this answer to a method of the robot, and do nothing."""
        self._methods[f"rob1.{method}"] = lambda _: answer

    def before_each(self, method: str, act: Callable[[int], object]) -> None:
        """Call `act` with the number of the request, from 1, before it is carried out."""
        carry_out, number = self._methods[f"rob1.{method}"], 0

        def noted(params: dict[str, Any]) -> Any:
            nonlocal number
            number += 1
            act(number)
            return carry_out(params)

        self._methods[f"rob1.{method}"] = noted

    def refuses_lines(self, code: int, refused: Callable[[dict[str, Any]], bool]) -> None:
        """Answer lines like these with this code and do not queue them."""
        move_line = self._methods["rob1.MotionControl.moveLine"]
        self._methods["rob1.MotionControl.moveLine"] = lambda p: code if refused(p) else move_line(p)


Act = Callable[[AuboArcs, Cabinet], Any]
"""What happens during a motion; the end of the task or coroutine that it returns, if any, is waited for."""


@pytest.fixture
async def cabinet() -> AsyncIterator[Cabinet]:
    """A controller with its power off, 20 times faster than life."""
    server = Cabinet(World(SimConfig(rate=RATE), SimClock(RATE, asyncio.get_running_loop().time)))
    await server.start(HOST, 0)
    yield server
    await server.stop()


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
async def make_arm(cabinet: Cabinet, notices: list[str]) -> AsyncIterator[MakeArm]:
    """An arm that is not connected, by fields of its table."""
    arms: list[AuboArcs] = []

    def make(**fields: Any) -> AuboArcs:
        table = {"kind": "aubo-arcs", "host": HOST, "port": cabinet.port, "tcp_offset_mm": (0.0, 0.0, 180.0), **fields}
        arms.append(AuboArcs(ArcsTable.model_validate(table), LIMITS, LoopClock(), notices.append))
        return arms[-1]

    yield make
    for arm in arms:
        await arm.close()


async def enabled(make: MakeArm, **fields: Any) -> AuboArcs:
    arm = make(**fields)
    await arm.connect()
    await arm.enable()
    return arm


@pytest.fixture
async def arm(make_arm: MakeArm) -> AuboArcs:
    """Connected, powered, brakes released."""
    return await enabled(make_arm)


@pytest.fixture
async def other(cabinet: Cabinet) -> AsyncIterator[Controller]:
    """A second client of the same cabinet."""
    client = Controller(HOST, cabinet.port)
    client.robot = "rob1"
    await client.open()
    yield client
    await client.close()


def cut(connection: RpcConnection) -> None:
    """End the connection from this side, as a pulled cable does."""
    assert connection._stream is not None
    connection._stream[1].transport.abort()


def mute(server: ArcsServer | RtdeServer) -> None:
    """Requests are neither carried out nor answered; nothing is pushed."""
    if isinstance(server, RtdeServer):
        server.faults.hang(Fault(device=Device.TELEMETRY, kind="mute", count=ALWAYS))
    else:
        server.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))


def mute_to(server: ArcsServer, method: str) -> None:
    """Requests of this method are carried out, but never answered."""
    server.faults.hang(Fault(device=Device.ROBOT, kind="mute", on=method, count=ALWAYS))
