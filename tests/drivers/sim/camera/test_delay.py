"""The delay of the loopback camera's pictures."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

import pytest

from brushloop.drivers.sim.camera.mjpeg_server import _Line
from brushloop.drivers.sim.config import View


class Loop:
    """A clock that stands still, and what is due on it."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.due_s: list[float] = []

    def time(self) -> float:
        return self.now_s

    def call_at(self, when_s: float, _call: Callable[..., None], _data: bytes) -> None:
        self.due_s.append(when_s)


class Open:
    """A connection; its client has taken everything once `taken` is set."""

    def __init__(self) -> None:
        self.taken = asyncio.Event()
        self.taken.set()

    def is_closing(self) -> bool:
        return False

    async def drain(self) -> None:
        await self.taken.wait()


async def test_the_time_to_draw_a_picture_is_a_part_of_its_delay_and_no_picture_overtakes_another() -> None:
    loop, line = Loop(), _Line(View(delay_s=0.3, delay_jitter_s=0.0), cast("asyncio.StreamWriter", Open()))
    line._loop = cast("asyncio.AbstractEventLoop", loop)
    line._last_s = line._began_s = loop.now_s
    for drawn_s in (0.05, 0.0, 2.0, 0.0):
        line.exposed()
        loop.now_s += drawn_s
        await line.send(b"picture")
    assert loop.due_s == pytest.approx([100.3, 100.35, 100.35, 102.35], abs=1e-3)
    assert loop.due_s == sorted(set(loop.due_s))


async def test_a_client_that_reads_too_slowly_is_sent_no_further_picture_until_it_has_taken_the_earlier_ones() -> None:
    client = Open()
    client.taken.clear()
    line = _Line(View(delay_s=0.3), cast("asyncio.StreamWriter", client))
    line.exposed()
    sending = asyncio.create_task(line.send(b"picture"))
    await asyncio.sleep(0)
    assert not sending.done()
    client.taken.set()
    await sending
