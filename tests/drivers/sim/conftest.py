"""A cabinet on a clock that the test turns."""

from __future__ import annotations

from typing import Any

import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance, to_wire
from brushloop.drivers.sim.cabinet import Cabinet, methods
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World

TOOL = [0.0, 0.0, 0.18, 0.0, 0.0, 0.0]
CABINETS_OWN = ("RuntimeMachine", "RegisterControl", "SystemInfo")


class StoppedClock:
    """A clock that stands still until it is turned."""

    rate = 1.0
    s = 0.0

    def now_s(self) -> float:
        return self.s

    def real_s(self) -> float:
        return self.s


class Bench:
    """A cabinet, its clock, and a caller. The tool is configured as it is."""

    def __init__(self) -> None:
        self.world = World(SimConfig())
        self.clock = self.world.clock = StoppedClock()  # type: ignore[assignment]
        self.cabinet = Cabinet(self.world)
        self.table = methods(self.cabinet)
        self.ask("RobotConfig.setTcpOffset", offset=TOOL)

    def ask(self, method: str, **params: Any) -> Any:
        name = method if method.split(".")[0] in CABINETS_OWN else f"rob1.{method}"
        return self.table[name](params)

    def line(self, target: Pose, v: float = 0.1, **more: float) -> int:
        return self.ask("MotionControl.moveLine", pose=to_wire(target), a=1.0, v=v, **more)

    def run(self) -> None:
        self.ask("RobotManage.poweron")
        self.clock.s += 1.5
        self.ask("RobotManage.startup")
        self.clock.s += 1.5

    @property
    def safety(self) -> str:
        return self.ask("RobotState.getSafetyModeType")

    @property
    def exec_id(self) -> int:
        return self.ask("MotionControl.getExecId")

    def off_mm(self, pose: Pose) -> float:
        return distance(self.world.tool(), pose)[0]


@pytest.fixture
def off() -> Bench:
    return Bench()


@pytest.fixture
def on(off: Bench) -> Bench:
    off.run()
    return off
