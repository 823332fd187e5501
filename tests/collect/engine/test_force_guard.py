"""The force ceiling: what is under way ends with the stop, and nothing is sent after it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from brushloop.collect.engine.recorder import ForceGuard
from brushloop.collect.errors import ForceTooHigh, arm_at_fault, describe, rest_is_unknown
from brushloop.drivers.devices import ForceSample, Stamp
from brushloop.drivers.errors import DeviceError, MotionFailed


class Cell:
    """An arm whose lines end at once and whose stops take a while, and a sensor that a test speaks for."""

    def __init__(self) -> None:
        self.did: list[str] = []
        self.say: Callable[[ForceSample], None] = lambda _: None

    def listen(self, on_sample: Callable[[ForceSample], None] | None) -> None:
        self.say = on_sample or (lambda _: None)

    def latest(self) -> None:
        pass

    async def move(self) -> None:
        self.did.append("line")
        await asyncio.sleep(0.0)

    async def stop(self) -> None:
        self.did.append("stop")
        await asyncio.sleep(0.05)
        self.did.append("at rest")

    async def press_too_hard(self) -> None:
        """Move down step by step, guarded, with 6 N from the third line on where 5 N are allowed."""
        rig: Any = SimpleNamespace(robot=self, force=self, config=SimpleNamespace(force=SimpleNamespace(max_n=5.0)))
        guard = ForceGuard(rig)
        guard.listen()

        async def down_step_by_step() -> None:
            while True:
                await self.move()
                if len(self.did) == 3:
                    self.say(ForceSample(Stamp(1), (0.0, 0.0, 6.0), (0.0, 0.0, 0.0)))

        await guard.guarded(down_step_by_step())


async def test_no_line_is_sent_after_the_stop_for_too_much_force() -> None:
    cell = Cell()
    with pytest.raises(ForceTooHigh, match=r"reached 6\.00 N"):
        await cell.press_too_hard()
    assert cell.did[cell.did.index("stop") :] == ["stop", "at rest"]


async def test_where_the_stop_fails_too_the_force_is_named_first_and_the_arm_counts_as_moving() -> None:
    class Runaway(Cell):
        async def stop(self) -> None:
            raise MotionFailed("robot", "stop", "not seen at rest", condition="The arm may still be moving.")

    with pytest.raises(DeviceError) as caught:
        await Runaway().press_too_hard()
    told = describe(caught.value)
    assert told.index("6.00 N") < told.index("The arm may still be moving.")
    assert rest_is_unknown(caught.value)
    assert arm_at_fault(caught.value)
