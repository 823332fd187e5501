"""The apps that `bench tui` measures, each alone in a process with a terminal of its own.

`python -m bench.tui_process ours|idle SECONDS FILE`: runs, then writes what it measured as JSON. `ours` is the run
screen over an engine that is fed force at 1 kHz, poses at 100 Hz and pictures at 5 Hz; `idle` is an app of textual with
a line of text, which asks for nothing and answers the stop key.
"""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

from textual.app import App, ComposeResult
from textual.widgets import Static

TICK_S = 0.01
READY = "brushloop"
STOPPING_S = 0.15


class Lag:
    """How late the app's loop comes back from a short sleep."""

    def __init__(self) -> None:
        self.late_ms: list[float] = []

    async def watch(self) -> None:
        """Until it is cancelled."""
        while True:
            due = time.perf_counter() + TICK_S
            await asyncio.sleep(TICK_S)
            self.late_ms.append(1e3 * (time.perf_counter() - due))


class Idle(App[None]):
    """An app that shows one line, asks for nothing, and answers the stop key in the least way."""

    def __init__(self) -> None:
        super().__init__()
        self.stops_ns: list[int] = []
        self._line = Static(READY)

    def compose(self) -> ComposeResult:
        """The line."""
        yield self._line

    def key_s(self) -> None:
        """Note the time, and say so for a moment."""
        self.stops_ns.append(time.monotonic_ns())
        self._line.update("STOP SENT")
        self.set_timer(STOPPING_S, lambda: self._line.update(READY))


def busy_engine() -> Any:
    """An engine without an arm whose telemetry comes at a rig's rates."""
    import numpy as np

    from collect.engine.control import State
    from collect.engine.snapshot import CellCount, Picture, Snapshot
    from collect.engine.telemetry import Telemetry
    from drivers.samples import ForceSample, Stamp

    class Busy:
        def __init__(self) -> None:
            self.telemetry = Telemetry()
            self.stops_ns: list[int] = []
            self._stopped_at = -1.0
            self._over = threading.Event()
            self._began = time.monotonic()
            self._threads = [
                threading.Thread(target=self._feed, args=(0.001, self._force)),
                threading.Thread(target=self._feed, args=(0.01, self._pose)),
                threading.Thread(target=self._feed, args=(0.2, self._picture)),
            ]
            self._rng = np.random.default_rng(0)
            light = 120.0 + 80.0 * np.linspace(0.0, 1.0, 320)[None, :] * np.linspace(1.0, 0.7, 240)[:, None]
            frames = [light + self._rng.normal(0.0, 4.0, (240, 320)) for _ in range(5)]
            self._frames = [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]
            self._count = 0

        def _feed(self, period_s: float, put: Any) -> None:
            due = time.monotonic()
            while not self._over.is_set():
                due += period_s
                put()
                time.sleep(max(0.0, due - time.monotonic()))

        def _force(self) -> None:
            stamp = Stamp(time.time_ns())
            self.telemetry.force(ForceSample(stamp, (0.0, 0.0, 0.03 + 0.02 * (stamp.host_ns // 10**8 % 7)), (0, 0, 0)))

        def _pose(self) -> None:
            now = time.monotonic()
            self.telemetry.tip_mm = (400.0 + 10.0 * (now % 5.0), -45.0, 120.0 + 20.0 * (now % 3.0))
            self.telemetry.target_mm = (410.0, -45.0, 130.0)

        def _picture(self) -> None:
            self._count += 1
            self.telemetry.picture = Picture(self._count, self._frames[self._count % 5], 0.9)

        def snapshot(self) -> Snapshot:
            now = time.monotonic()
            state = State.STOPPING if now - self._stopped_at < STOPPING_S else State.RUNNING
            trace = self.telemetry.trace_n()
            return Snapshot(
                session_id="bench",
                source="bench",
                state=state,
                step=f"press {int(now) % 30}",
                strokes_done=13,
                strokes_planned=150,
                grid=tuple(CellCount(float(h), float(a), 3, 10) for h in (11, 13, 15, 17, 20) for a in (0, 5, 10)),
                voids=0,
                elapsed_s=now - self._began,
                eta_s=100.0,
                tip_mm=self.telemetry.tip_mm,
                messages=tuple(f"line {n}" for n in range(50)),
                error="",
                force_n=trace[-1] if trace else None,
                target_mm=self.telemetry.target_mm,
                trace_n=trace,
                picture=self.telemetry.picture,
            )

        def stop(self) -> None:
            self.stops_ns.append(time.monotonic_ns())
            self._stopped_at = time.monotonic()

        def start(self) -> None:
            for thread in self._threads:
                thread.start()

        def end(self) -> None:
            self._over.set()
            for thread in self._threads:
                thread.join()

    return Busy()


def main(kind: str, seconds: float, file: Path) -> None:
    """Run one app for so long and write its figures."""
    engine = None
    if kind == "ours":
        from collect.tui.app import OperatorApp

        engine = busy_engine()
        engine.start()
        app: App[None] = OperatorApp(engine)
    else:
        app = Idle()
    lag, figures = Lag(), {}

    async def measure() -> None:
        watch = asyncio.create_task(lag.watch())
        await asyncio.sleep(1.0)  # past its start
        lag.late_ms.clear()
        before = time.perf_counter(), time.process_time(), time.thread_time()
        await asyncio.sleep(seconds)
        wall, process, thread = (
            b - a for a, b in zip(before, (time.perf_counter(), time.process_time(), time.thread_time()), strict=True)
        )
        watch.cancel()
        figures.update(wall_s=wall, process_s=process, ui_s=thread)
        app.exit()

    app.call_later(lambda: app.run_worker(measure()))
    app.run()
    if engine is not None:
        engine.end()
        figures["stops_ns"] = engine.stops_ns
    if isinstance(app, Idle):
        figures["stops_ns"] = app.stops_ns
    file.write_text(json.dumps({**figures, "late_ms": lag.late_ms}), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), Path(sys.argv[3]))
