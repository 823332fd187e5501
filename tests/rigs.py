"""Loopback rigs for a collection: one that serves on sockets in real time, and one without wires in simulated time."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import subprocess
import sys
import threading
from collections.abc import AsyncGenerator, Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import can
import pytest

from brushloop.collect import start
from brushloop.collect.engine.engine import Engine, engine_for
from brushloop.collect.engine.open_or_resume import CollectRequest, Opening
from brushloop.collect.rig import devices
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import Rig, connected
from brushloop.drivers.arcs import wire
from brushloop.drivers.camera.source import CameraTable
from brushloop.drivers.devices import Frame, Identity, Stamp
from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.force.simulator import ERROR_FRAME
from brushloop.drivers.force.sri_m8123 import SriM8123
from brushloop.drivers.host import Clock
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.faults import Device
from brushloop.drivers.sim.rig import PORTS, LoopbackRig, rig_toml
from brushloop.drivers.sim.world import Press, SimClock
from brushloop.sessions.journal import JOURNAL_NAME, RunState, replay
from tests.command import brushloop
from tests.runs import SteppedEngine, end, wait_for_end
from tests.simulated_time import MemoryLoop, SimulatedTime
from tests.waiting import PATIENCE_S

SMALL_VIEW = View(width_px=512, height_px=384, px_per_mm=1.56, fps=15.0)
SMALL_TABLE = Table(
    sheet_mm=(110.0, 80.0),
    board_origin_mm=(-20.0, -20.0),
    board_squares=(15, 12),
    board_square_mm=10.0,
    board_marker_mm=7.0,
    well_mm=(150.0, 20.0),
)
SHARP_VIEW = View(width_px=1024, height_px=832, px_per_mm=6.25, centre_mm=(55.0, 40.0), fps=12.0)
"""Of the small table, as sharp as the camera is by default: a quarter of its pixels."""
BENT_VIEW = View(width_px=1024, height_px=768, px_per_mm=3.125, fps=12.0, k1=-0.08)
"""Of a whole sheet, through a lens that distorts by ten pixels and more."""
COARSE = SimConfig(rate=60.0, view=SMALL_VIEW, force_hz=100.0)
"""A camera too coarse to judge ink by."""
BARE = SimConfig(rate=300.0, view=SMALL_VIEW, ink_device="none", force_sensor=False)
"""The same, without ink device and force sensor, and fast."""
SHARP = SimConfig(rate=60.0, view=SHARP_VIEW, table=SMALL_TABLE)
WIPE = "\n[ink.wipe]\nrim_mm = [322.0, 20.0]\nz_mm = 130.0\n"
WASH = "\n[ink.wash]\npot_mm = [305.0, 80.0]\ndip_z_mm = 125.0\nevery_dips = 2\nstrokes = 2\n"
"""Tables of a `rig.toml`, at places beside the sheet that the arm reaches."""
TOUCH_DEPTH_MM = 1.0
"""Zero touch goes no deeper; it visits its own place in every process."""

_R = TypeVar("_R")


@contextlib.contextmanager
def in_thread(servers: AbstractAsyncContextManager[_R]) -> Iterator[tuple[_R, asyncio.AbstractEventLoop]]:
    """They serve from another thread's event loop until the block ends."""
    ready: Future[tuple[_R, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve() -> None:
        over = asyncio.Event()
        try:
            async with servers as entered:
                ready.set_result((entered, asyncio.get_running_loop(), over))
                await over.wait()
        except BaseException as error:
            if not ready.done():
                ready.set_exception(error)
            raise

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="servers", daemon=True)
    thread.start()
    entered, loop, over = ready.result(timeout=PATIENCE_S)
    try:
        yield entered, loop
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(timeout=PATIENCE_S)
        assert not thread.is_alive(), f"waited {PATIENCE_S:g} s for the servers to end"


@dataclass
class Lab:
    """A rig, its configuration on disk, and a folder for sessions."""

    rig: LoopbackRig
    folder: Path
    processes: list[subprocess.Popen[str]] = field(default_factory=list)
    engines: list[SteppedEngine] = field(default_factory=list)
    loop: asyncio.AbstractEventLoop | None = None
    """In which a rig on sockets is served, by a thread of its own."""

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"

    @property
    def session(self) -> Path:
        """The folder of the only session."""
        [folder] = self.sessions.iterdir()
        return folder

    @property
    def state(self) -> RunState:
        """What the journal of the only session says."""
        return replay(self.session / JOURNAL_NAME)

    @property
    def presses(self) -> list[Press]:
        """What was pressed so far, without the zero touches."""
        return [press for press in self.rig.world.presses if press.depth_mm > TOUCH_DEPTH_MM]

    @property
    def at_rest(self) -> bool:
        """Nothing moves and nothing is queued."""
        return self.rig.world.motion.exec_id(self.rig.world.clock.now_s()) == -1

    def engine(self, **options: Any) -> SteppedEngine:
        """As `brushloop collect` makes it; `options` are those of a `CollectRequest`."""
        request = CollectRequest(self.folder / "rig.toml", self.folder / "protocol.toml", self.sessions, **options)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("brushloop.collect.engine.engine.Engine", SteppedEngine)
            engine: Any = engine_for(Opening.load(request))
        self.engines.append(engine)
        return engine

    def started(self, **options: Any) -> SteppedEngine:
        """An engine on its way."""
        engine = self.engine(**options)
        engine.start()
        return engine

    def run(self, **options: Any) -> SteppedEngine:
        """An engine at its end. Raises what ended it."""
        engine = self.started(**options)
        wait_for_end(engine)
        return engine

    def process(self) -> subprocess.Popen[str]:
        """`brushloop collect` as an operator starts it, without a screen."""
        command = [sys.executable, "-m", "brushloop", "collect", "--no-tui", *self.options]
        self.processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return self.processes[-1]

    def command(self, *more: str) -> subprocess.CompletedProcess[str]:
        """The same in this process."""
        return brushloop("collect", "--no-tui", *more, *self.options)

    @property
    def options(self) -> list[str]:
        """Of `brushloop collect`: where its files lie."""
        config, protocol = self.folder / "rig.toml", self.folder / "protocol.toml"
        return ["--out", str(self.sessions), "--config", str(config), "--protocol", str(protocol)]

    def edit_rig(self, old: str, new: str) -> None:
        """Change `rig.toml`; with nothing old, append to it."""
        path = self.folder / "rig.toml"
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new) if old else text + new, encoding="utf-8")

    def write_protocol(
        self, heights: str = "[11.0, 15.0]", tilts: str = "[0.0]", repeats: int = 1, dwell_s: float = 0.0
    ) -> None:
        """A grid; two strokes unless more are asked for."""
        text = f'kind = "grid"\ndepths_mm = {heights}\ntilts_deg = {tilts}\nrepeats = {repeats}\ndwell_s = {dwell_s}\n'
        (self.folder / "protocol.toml").write_text(text, encoding="utf-8")


def coarse(lab: Lab) -> Lab:
    """Write its files: captures are not judged, and two strokes are pressed."""
    text = lab.rig.toml().replace("latency_ms = 250.0", "latency_ms = 60.0") + "\n[quality]\nenabled = false\n"
    (lab.folder / "rig.toml").write_text(text.replace("[force]", "[force]\nbias_s = 0.25"), encoding="utf-8")
    lab.write_protocol()
    return lab


def sharp(lab: Lab, latency_ms: int = 100) -> Lab:
    """Write its files: captures are judged, one stroke is pressed, and nothing splits by itself."""
    text = lab.rig.toml().replace("latency_ms = 250.0", f"latency_ms = {latency_ms}")
    (lab.folder / "rig.toml").write_text(text.replace("[force]", "[force]\nbias_s = 0.25"), encoding="utf-8")
    lab.write_protocol("[13.0]", "[0.0]")
    lab.rig.world.splits.update(dict.fromkeys(range(20), 0.0))
    return lab


@contextlib.contextmanager
def wired_lab(folder: Path, config: SimConfig = COARSE) -> Iterator[Lab]:
    """A coarse lab on sockets, whose processes end with the block."""
    with in_thread(LoopbackRig(config)) as (rig, loop):
        lab = coarse(Lab(rig, folder, loop=loop))
        for limit in ("max_delay_ms = 3000.0", "max_jitter_ms = 2000.0"):
            lab.edit_rig(limit, f"{limit.partition(' ')[0]} = 10000.0")  # of a busy machine
        yield lab
        for process in lab.processes:
            process.kill()
            process.communicate()


# Without wires

_rigs = itertools.count()


def _own_address() -> str:
    """A loopback address of a rig's own on this machine: two arms at one address would be taken for one arm."""
    number = os.getpid() * 64 + next(_rigs)
    return ".".join(["127", *(str(number >> shift & 255) for shift in (16, 8, 0))])


class WorldClock(SimClock):
    """The world's time, which passes `rate` times as fast as that of the loop."""

    def __init__(self, time: SimulatedTime, rate: float) -> None:
        super().__init__(rate, time.seconds)
        self._time = time
        self._since = time.now_s, 0.0

    def now_s(self) -> float:
        since_s, world_s = self._since
        return world_s + (self._time.now_s - since_s) * self.rate

    def shift(self, rate: float) -> None:
        """Go on at another pace."""
        self._since, self.rate = (self._time.now_s, self.now_s()), rate


class WirelessRig(LoopbackRig):
    """The loopback rig in the event loop of the run: the arm's driver is connected in memory, the other drivers read
    their devices directly."""

    def __init__(self, config: SimConfig) -> None:
        self.address = _own_address()
        super().__init__(config, self.address)
        self.time = SimulatedTime()
        self.clock = WorldClock(self.time, config.rate)
        self.world.clock = self.clock

    def toml(self) -> str:
        return rig_toml(self.config, self.address, "in memory")

    @contextlib.asynccontextmanager
    async def connected(self, config: RigConfig, clock: Clock, on_notice: Callable[[str], None]) -> AsyncGenerator[Rig]:
        """In place of `brushloop.collect.rig.devices.connected`."""
        async with contextlib.AsyncExitStack() as stack:
            patch = stack.enter_context(pytest.MonkeyPatch.context())
            patch.setattr(devices, "OpenCvCamera", lambda table, clock, _: SceneCamera(self, table, clock))
            patch.setattr(devices, "SriM8123", lambda *arguments: LoopSensor(self, *arguments))
            patch.setattr("serial.serial_for_url", lambda *_, **__: MemoryLine(self.ink and self.ink.instrument))
            for server, port in ((self.arcs, PORTS["arcs"]), (self.rtde, PORTS["rtde"])):
                await server.start(self.address, port)
                stack.push_async_callback(server.stop)
            watching = asyncio.create_task(self.faults.watch(self.arcs.cabinet.safety_stop), name="faults")
            stack.callback(watching.cancel)
            yield await stack.enter_async_context(connected(config, clock, on_notice))


class SceneCamera:
    """`Camera` that sees the scene itself: a picture is drawn only when somebody asks for it."""

    def __init__(self, rig: WirelessRig, table: CameraTable, clock: Clock) -> None:
        self._rig, self._table, self._clock = rig, table, clock
        self._latency_ns = round(table.latency_ms * 1e6)
        self._newest: Frame | None = None

    async def connect(self) -> Identity:
        height, width = (await self.fresh(Stamp(0))).image.shape[:2]
        return Identity(f"{self._table.source} {width}x{height}", "", True)

    async def fresh(self, after: Stamp) -> Frame:
        began_ns, period_ns = self._clock.now_ns(), round(1e9 / self._rig.config.view.fps)
        while self._newest is None or self._newest.exposed_after_ns < after.host_ns:
            now_ns = self._clock.now_ns()
            due_ns = (max(now_ns, after.host_ns + self._latency_ns) // period_ns + 1) * period_ns
            await asyncio.sleep((due_ns - now_ns) / 1e9)
            if self._rig.faults.meet(Device.CAMERA) is None:
                seq = 0 if self._newest is None else self._newest.stamp.seq + 1
                image = self._rig.scene.render(self._rig.world.tool())
                self._newest = Frame(Stamp(due_ns, None, seq), due_ns - self._latency_ns, image)
            elif due_ns - began_ns > self._table.timeout_s * 1e9:
                raise DeviceTimeout("camera", "fresh", f"no valid new frame in {self._table.timeout_s:g} s")
        return self._newest

    async def close(self) -> None:
        self._newest = None


class LoopSensor(SriM8123):
    """The force sensor, whose rounds are read by a task instead of a thread."""

    def __init__(self, rig: WirelessRig, *arguments: Any) -> None:
        super().__init__(*arguments)
        assert rig.force is not None
        self._rig, self._board = rig, rig.force.board

    async def connect(self) -> Identity:
        self._board.streaming = True
        self._task = asyncio.create_task(self._read(), name="force rounds")
        return await super().connect()

    async def close(self) -> None:
        await super().close()
        self._task.cancel()

    def _run(self) -> None:
        """Leave the thread without work."""

    async def _read(self) -> None:
        while self._loss is None:
            for can_id, data in self._board.round():
                at_s, is_error = self._rig.time.now_s, bool(can_id & ERROR_FRAME)
                self._take(can.Message(at_s, can_id & ~ERROR_FRAME, False, False, is_error, data=data))
            await asyncio.sleep(1.0 / self._rig.config.force_hz)


class MemoryLine:
    """The serial line of an ink device: as much of pyserial's `Serial` as its driver uses."""

    def __init__(self, instrument: Any) -> None:
        self.instrument = instrument
        self.came = b""
        """What waits to be read."""

    @property
    def in_waiting(self) -> int:
        return len(self.came)

    def write(self, data: bytes) -> None:
        self.came += self._answered(data)

    def read(self, size: int) -> bytes:
        taken, self.came = self.came[:size], self.came[size:]
        return taken

    def close(self) -> None:
        pass

    def _answered(self, request: bytes) -> bytes:
        return self.instrument.answer(request) or b""


@contextlib.contextmanager
def wireless_lab(folder: Path, config: SimConfig = COARSE) -> Iterator[Lab]:
    """A lab whose runs, within the block, need neither wires nor time; write its files with `coarse` or `sharp`."""
    rig = WirelessRig(config)
    with pytest.MonkeyPatch.context() as patch:
        # nobody waits for a busy machine here, nor for its disk: nothing is killed
        patch.setattr(wire, "REPLY_S", 1.0)
        patch.setattr("os.fsync", lambda _: None)
        patch.setattr("brushloop.collect.engine.engine.connected", rig.connected)
        patch.setattr(Engine, "new_event_loop", staticmethod(lambda: MemoryLoop(rig.time)))
        patch.setattr("brushloop.collect.engine.engine.Clock", lambda: rig.time)
        patch.setattr(start, "REFRESH_S", 0.01)
        lab = Lab(rig, folder)
        yield lab
        for engine in lab.engines:
            end(engine)
