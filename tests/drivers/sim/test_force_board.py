"""The simulated force board on its socketcand server."""

from __future__ import annotations

import asyncio
import itertools
import time

import pytest

from brushloop.drivers.force.rounds import COMMAND_ID, LOOPBACK_CHANNEL, START
from brushloop.drivers.sim.instruments.force_board import FRAME_S, ForceBoard, SocketcandServer


async def test_the_frames_of_a_round_are_one_burst_on_a_busy_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    late_s = itertools.count(1000.0, 0.05)
    monkeypatch.setattr(time, "time", lambda: next(late_s))
    server = SocketcandServer(ForceBoard(lambda _: (0.0,) * 6), lambda: 0.0, rate_hz=100.0)
    await server.start("127.0.0.1", 0)
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    command = f"< send {COMMAND_ID:03X} {len(START):x} {' '.join(f'{byte:02X}' for byte in START)} >"
    writer.write(f"< open {LOOPBACK_CHANNEL} >< rawmode >{command}".encode())
    times_s: list[float] = []
    while len(times_s) < 3:
        words = (await reader.readuntil(b">")).decode().split()
        if words[1] == "frame":
            times_s.append(float(words[3]))
    writer.close()
    await writer.wait_closed()
    await server.stop()
    assert [b - a for a, b in itertools.pairwise(times_s)] == pytest.approx([FRAME_S, FRAME_S], abs=1e-6)
