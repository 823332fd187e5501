"""A rig for one session with one fault: fast until the fault strikes; waits that have to run out are cut short."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import pytest

from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.open_or_resume import Opening, find_resumable, open_store
from brushloop.drivers.arcs import stopping
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.drivers.sim.world import SimClock
from tests.waiting import PATIENCE_S

FAST = 300.0
CONFIRM_S = 1.2
CAMERA_TIMEOUT_S = 15.0
"""Long enough for a busy machine; whoever waits for a time-out makes it short."""
PROTOCOL = 'kind = "grid"\ndepths_mm = [15.0]\ntilts_deg = [0.0]\nrepeats = 1\ndwell_s = 1.0\n'


class Gears(SimClock):
    """Simulated time whose pace can be changed while it runs."""

    def __init__(self) -> None:
        super().__init__(FAST)
        self._since = (time.monotonic(), 0.0)

    def now_s(self) -> float:
        real_s, sim_s = self._since
        return sim_s + (time.monotonic() - real_s) * self.rate

    def shift(self, rate: float) -> None:
        now_s = self.now_s()
        self._since = (time.monotonic(), now_s)
        self.rate = rate


@dataclass
class Stage:
    """A rig that serves from a thread of its own, its configuration on disk, and a folder for one session."""

    rig: LoopbackRig
    loop: asyncio.AbstractEventLoop
    gears: Gears
    folder: Path

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"

    @property
    def at_rest(self) -> bool:
        """Nothing moves and nothing is queued."""
        cabinet = self.rig.arcs.cabinet
        return cabinet.motion.exec_id(cabinet.now_s()) == -1 and cabinet.motion.size == 0

    def engine(self) -> Engine:
        clock = HostClock()
        opening = Opening.load(self.sessions, self.folder / "rig.toml", self.folder / "protocol.toml")
        resume = find_resumable(opening)
        return Engine(opening.rig, opening.protocol, lambda rig: open_store(opening, resume, rig, clock), clock)

    def ask(self, *methods: str) -> None:
        """Requests of somebody else's, one after the other."""

        async def send() -> None:
            connection = RpcConnection("127.0.0.1", self.rig.arcs.port)
            await connection.open()
            for method in methods:
                await connection.call(method)
            await connection.close()

        asyncio.run(send())


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    ready: Future[tuple[LoopbackRig, asyncio.AbstractEventLoop, asyncio.Event]] = Future()
    gears = Gears()
    view = View(width_px=512, height_px=384, px_per_mm=1.56, fps=20.0)

    async def serve() -> None:
        over = asyncio.Event()
        rig = LoopbackRig(SimConfig(rate=FAST, view=view, ink_device="none", force_sensor=False))
        rig.world.clock = gears
        async with rig:
            ready.set_result((rig, asyncio.get_running_loop(), over))
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="loopback rig", daemon=True)
    thread.start()
    rig, loop, over = ready.result(timeout=PATIENCE_S)
    text = rig.toml().replace("latency_ms = 250.0", f"latency_ms = 60.0\ntimeout_s = {CAMERA_TIMEOUT_S}")
    text = re.sub("least_dwell_s = .*", "", text)  # a phase is struck at half real speed
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    (tmp_path / "protocol.toml").write_text(PROTOCOL, encoding="utf-8")
    monkeypatch.setattr(stopping, "CONFIRM_S", CONFIRM_S)
    yield Stage(rig, loop, gears, tmp_path)
    loop.call_soon_threadsafe(over.set)
    thread.join(timeout=PATIENCE_S)
    assert not thread.is_alive(), f"waited {PATIENCE_S:g} s for the loopback rig to end"
