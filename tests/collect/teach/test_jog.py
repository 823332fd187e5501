"""Jog by keys: nothing moves without `--arm` and its key, and no step leads out of the box that is known so far."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from brushloop.collect.teach.arm import taught_arm
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Answer, Brought, JogStep, JogView, Question, Target
from brushloop.collect.teach.jog import BELOW_MM, touch
from brushloop.collect.teach.store import touch_of
from brushloop.drivers.arcs.controller import RobotMode
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World
from tests.collect.teach.conftest import Person, day_of

HOME_MM = (250.0, -230.0, 260.0)


class Jogger(Person):
    """Jogs by a list of steps, then says that the tip is there."""

    def __init__(self, *steps: JogStep, allows: bool = True) -> None:
        super().__init__()
        self.steps, self.allows = list(steps), allows
        self.views: list[JogView] = []

    async def ask(self, question: Question) -> Answer:
        if question.jog is not None:
            self.views.append(question.jog)
            return self.steps.pop(0) if self.steps else Brought.DONE
        if question.target is None:
            return "a" if self.allows else question.default
        self.asked.append(question.text)
        return Brought.JOG if len(self.asked) == 1 else Brought.SKIP


async def touched(day: Day) -> None:
    async with asyncio.timeout(20.0), taught_arm(day.notebook) as reader:
        await touch(day, reader, Target("well"), "Bring the tip into the well.", "well 0")


def sent(server: ArcsServer) -> int:
    """Number of lines that the controller was given."""
    return server.cabinet.world.motion._next_id


async def test_steps_move_the_tip_along_the_base_and_the_place_is_kept(server: ArcsServer, tmp_path: Path) -> None:
    person = Jogger(JogStep("x", 5.0), JogStep("y", -0.5), JogStep("z", -2.0))
    day = day_of(person, tmp_path, server.port, armed=True)
    await touched(day)
    assert person.views[-1].moved_mm == pytest.approx((5.0, -0.5, -2.0), abs=0.05)
    x, y, z = HOME_MM
    assert day.notebook.touches["well 0"].position_mm == pytest.approx((x + 5.0, y - 0.5, z + 180.0 - 2.0), abs=0.05)
    assert sent(server) == 3


@pytest.mark.parametrize(("armed", "allows"), [(False, True), (True, False)], ids=["no --arm", "no key"])
async def test_without_arm_or_key_nothing_moves(armed: bool, allows: bool, server: ArcsServer, tmp_path: Path) -> None:
    person = Jogger(JogStep("x", 5.0), allows=allows)
    await touched(day_of(person, tmp_path, server.port, armed=armed))
    assert person.views == []
    assert armed or "Nothing is moved without --arm" in person.said[0]
    assert sent(server) == 0
    assert server.cabinet.power.mode == RobotMode.POWER_OFF


async def test_a_step_out_of_the_box_is_refused_and_said(server: ArcsServer, tmp_path: Path) -> None:
    down = [JogStep("z", -5.0)] * (int(BELOW_MM / 5.0) + 1)
    person = Jogger(*down, JogStep("x", -5.0), JogStep("x", 100.0))
    day = day_of(person, tmp_path, server.port, armed=True)
    x, y, z = HOME_MM
    day.save(day.notebook.with_touch("pin 0", touch_of(brush_pose(x + 40.0, y, z + 190.0))))
    await touched(day)
    refused = [view.refused for view in person.views]
    assert refused[:2] == ["", ""]
    assert refused[2].startswith("not made: z = 250.000 mm is outside [255.000,")
    assert refused[3:] == ["", "100 mm is not one of the steps"]
    assert sent(server) == 2


async def test_a_stop_in_the_middle_of_a_step_stops_the_arm(tmp_path: Path) -> None:
    server = ArcsServer(World(SimConfig(rate=0.5)))
    await server.start("127.0.0.1", 0)
    motion = server.cabinet.world.motion
    task = asyncio.create_task(touched(day_of(Jogger(JogStep("x", 5.0)), tmp_path, server.port, armed=True)))
    async with asyncio.timeout(20.0):
        while motion.target(server.cabinet.now_s()) is None:
            await asyncio.sleep(0.005)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    assert motion.target(server.cabinet.now_s()) is None
    assert server.cabinet.world.tool().x_mm < HOME_MM[0] + 4.0
    await server.stop()
