"""A loopback rig in a thread of its own, as small and fast as the collection needs it."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.open_or_resume import Opening, find_resumable, open_store
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.force import sri_m8123 as stream
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.rig import LoopbackRig
from tests.collect.until import wait_for_end
from tests.waiting import PATIENCE_S

OPTIONS = ("--out", "--config", "--protocol")
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


RPC_TIMEOUT_S = 10.0


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated cabinet and the force board may have to wait for their turn on a busy machine."""
    monkeypatch.setitem(RpcConnection.__init__.__kwdefaults__, "timeout_s", RPC_TIMEOUT_S)
    monkeypatch.setattr(stream, "SILENT_S", PATIENCE_S)


@contextmanager
def serving(config: SimConfig) -> Iterator[LoopbackRig]:
    """The rig serves from another thread's event loop until the block ends."""
    ready: Future[tuple[LoopbackRig, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve() -> None:
        over = asyncio.Event()
        async with LoopbackRig(config) as rig:
            ready.set_result((rig, asyncio.get_running_loop(), over))
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="loopback rig", daemon=True)
    thread.start()
    rig, loop, over = ready.result(timeout=PATIENCE_S)
    try:
        yield rig
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(timeout=PATIENCE_S)
        assert not thread.is_alive(), f"waited {PATIENCE_S:g} s for the loopback rig to end"


@dataclass
class Lab:
    """A rig that serves, its configuration on disk, and a folder for sessions."""

    rig: LoopbackRig
    folder: Path
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"

    def engine(
        self,
        *,
        new: bool = False,
        sheet: int | None = None,
        armed: bool = False,
        watched: bool = False,
        guided: bool = False,
        preview: bool = False,
    ) -> Engine:
        rig, protocol, clock = self.folder / "rig.toml", self.folder / "protocol.toml", HostClock()
        opening = Opening.load(self.sessions, rig, protocol, new=new, sheet=sheet)
        resume = find_resumable(opening)
        return Engine(
            opening.rig,
            opening.protocol,
            lambda r: open_store(opening, resume, r, clock),
            clock,
            resumes=resume,
            watched=watched,
            armed=armed,
            guided=guided,
            preview=preview,
        )

    def process(self) -> subprocess.Popen[str]:
        """`brushloop collect` as an operator starts it, without a screen."""
        command = [sys.executable, "-m", "brushloop", "collect", "--no-tui", *self.options]
        self.processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return self.processes[-1]

    @property
    def options(self) -> list[str]:
        """Of `brushloop collect`: where its files lie."""
        paths = (self.sessions, self.folder / "rig.toml", self.folder / "protocol.toml")
        return [word for option, path in zip(OPTIONS, paths, strict=True) for word in (option, str(path))]

    def write_protocol(
        self, heights: str = "[11.0, 15.0]", tilts: str = "[0.0]", repeats: int = 1, dwell_s: float = 0.0
    ) -> None:
        """A grid; two strokes unless more are asked for."""
        text = f'kind = "grid"\ndepths_mm = {heights}\ntilts_deg = {tilts}\nrepeats = {repeats}\ndwell_s = {dwell_s}\n'
        (self.folder / "protocol.toml").write_text(text, encoding="utf-8")


@contextmanager
def coarse(folder: Path, rate: float = 60.0) -> Iterator[Lab]:
    """A camera too coarse to judge ink by, and two strokes."""
    with serving(SimConfig(rate=rate, view=SMALL_VIEW, force_hz=100.0)) as rig:
        made = Lab(rig, folder)
        text = rig.toml().replace("latency_ms = 250.0", "latency_ms = 60.0")
        text += "\n[quality]\nenabled = false\n"
        (folder / "rig.toml").write_text(text.replace("[force]", "[force]\nbias_s = 0.25"), encoding="utf-8")
        made.write_protocol()
        yield made
        for process in made.processes:
            process.kill()
            process.communicate()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with coarse(tmp_path) as made:
        yield made


@pytest.fixture
def slow_lab(tmp_path: Path) -> Iterator[Lab]:
    """The same, slow enough that another client's line does not pass between two questions of the driver."""
    with coarse(tmp_path, rate=10.0) as made:
        yield made


@dataclass
class Collected:
    """A session of four strokes, from its beginning to its end."""

    lab: Lab
    """Its rig has ended; the world remembers what was pressed."""
    engine: Engine

    @property
    def folder(self) -> Path:
        [folder] = self.lab.sessions.iterdir()
        return folder


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Collected:
    """For whoever only looks at what a run leaves; nobody writes into it."""
    with coarse(tmp_path_factory.mktemp("collected")) as lab:
        lab.write_protocol(tilts="[0.0, 10.0]")
        engine = lab.engine()
        engine.start()
        wait_for_end(engine)
    return Collected(lab, engine)


@pytest.fixture
def sharp_lab(tmp_path: Path) -> Iterator[Lab]:
    """Sharp enough that captures are judged, on a small sheet; one stroke, and nothing splits by itself."""
    with sharp(tmp_path, SHARP_VIEW) as made:
        yield made


@pytest.fixture
def bent_lab(tmp_path: Path) -> Iterator[Lab]:
    """A whole sheet through a lens that distorts by ten pixels and more; no lens file is named yet."""
    view = View(width_px=1024, height_px=768, px_per_mm=3.125, fps=12.0, k1=-0.08)
    with sharp(tmp_path, view, Table(), latency_ms=500) as made:
        yield made


@contextmanager
def sharp(tmp_path: Path, view: View, table: Table = SMALL_TABLE, latency_ms: int = 100) -> Iterator[Lab]:
    """A self-check photographs as soon as the arm has left; on a busy machine frames are older than usual."""
    with serving(SimConfig(rate=60.0, view=view, table=table)) as rig:
        made = Lab(rig, tmp_path)
        text = (
            rig.toml()
            .replace("latency_ms = 250.0", f"latency_ms = {latency_ms}")
            .replace("[force]", "[force]\nbias_s = 0.25")
        )
        (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
        made.write_protocol("[13.0]", "[0.0]")
        rig.world.flaws.update(dict.fromkeys(range(20), (Flaw.SPLIT, 0.0)))
        yield made
