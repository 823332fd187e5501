"""A person who is asked nothing, a controller, and a visit on which the arm and its tip are known."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from brushloop.collect.commission.step import Guide, LeftOff, Visit
from brushloop.collect.operator import Prompt
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World


class Person(Guide):
    """Leaves at the first question."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []

    @property
    def said(self) -> list[str]:
        return [line for what in self.findings for line in what.lines]

    async def ask(self, prompt: Prompt) -> Any:
        self.asked.append(prompt.question)
        raise LeftOff


@pytest.fixture
async def server() -> AsyncIterator[ArcsServer]:
    server = ArcsServer(World(SimConfig(rate=10.0)))
    await server.start("127.0.0.1", 0)
    yield server
    await server.stop()


def visit_of(
    person: Person,
    folder: Path,
    port: int = 9,
    *,
    tip_mm: tuple[float, float, float] = (0.0, 0.0, 180.0),
) -> Visit:
    """A visit on which the arm and its tip are known."""
    visit = Visit(person, folder / "rig.toml", HostClock(), armed=False)
    for name, value in (("host", "127.0.0.1"), ("port", port), ("framing", "sof")):
        visit.keep("arm", f"robot.{name}", value, "typed")
    visit.keep("tip", "robot.tcp_offset_mm", list(tip_mm), "typed", "mm")
    visit.keep("tip", "robot.tcp_rotation_deg", [0.0, 0.0, 0.0], "typed", "deg")
    return visit
