"""A person who is asked nothing, a controller, and a day on which the arm and its tip are known."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from brushloop.collect.operator import Prompt
from brushloop.collect.teach.day import Day, LeftOff, Picture, Shown, Target
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World


class Person:
    """Leaves at the first question, and keeps what was said."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.said: list[str] = []

    async def begin(self, step: str) -> None:
        pass

    async def show(self, what: Shown) -> None:
        self.said += what.lines

    def see(self, picture: Picture | None) -> None:
        pass

    async def ask(self, prompt: Prompt, target: Target | None = None) -> Any:
        self.asked.append(prompt.question)
        raise LeftOff


@pytest.fixture
async def server() -> AsyncIterator[ArcsServer]:
    server = ArcsServer(World(SimConfig(rate=10.0)))
    await server.start("127.0.0.1", 0)
    yield server
    await server.stop()


def day_of(
    person: Person,
    folder: Path,
    port: int = 9,
    *,
    tip_mm: tuple[float, float, float] = (0.0, 0.0, 180.0),
) -> Day:
    """A day on which the arm and its tip are known."""
    day = Day(person, folder / "rig.toml", HostClock(), armed=False)
    for name, value in (("host", "127.0.0.1"), ("port", port), ("framing", "sof")):
        day.keep("arm", f"robot.{name}", value, "typed")
    day.keep("tip", "robot.tcp_offset_mm", list(tip_mm), "typed", "mm")
    day.keep("tip", "robot.tcp_rotation_deg", [0.0, 0.0, 0.0], "typed", "deg")
    return day
