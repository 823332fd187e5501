"""While a person guides the arm, the screen shows where it is; nobody asks the arm to do anything."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from brushloop.collect.teach.day import Day
from brushloop.collect.teach.watch import watched
from brushloop.collect.tui.teach_guide import ScreenGuide
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.world import World


async def test_the_flange_is_shown_and_the_tip_once_it_is_taught(tmp_path: Path) -> None:
    server = ArcsServer(World(SimConfig()))
    await server.start("127.0.0.1", 0)
    guide = ScreenGuide()
    day = Day(guide, tmp_path / "rig.toml", HostClock(), armed=False)
    for field, value in (("host", "127.0.0.1"), ("port", server.port), ("framing", "sof")):
        day.keep("arm", f"robot.{field}", value, "typed")
    async with watched(day, guide.see_pose, guide.see_picture, lambda: guide.looking), asyncio.timeout(20.0):
        while guide.view.tip is None:
            await asyncio.sleep(0.01)
        assert not guide.view.tip_known
        assert guide.view.tip.position_mm == pytest.approx((250.0, -230.0, 440.0), abs=0.01)
        day.keep("tip", "robot.tcp_offset_mm", [0.0, 0.0, 180.0], "typed", unit="mm")
        while not guide.view.tip_known:
            await asyncio.sleep(0.01)
        assert guide.view.tip.position_mm == pytest.approx((250.0, -230.0, 260.0), abs=0.01)
    assert guide.view.tip is None
    await server.stop()
