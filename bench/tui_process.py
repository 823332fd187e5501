"""The apps that `bench tui` measures, each alone in a process with a terminal of its own.

`python -m bench.tui_process ours|idle SECONDS FILE`: runs, then writes what it measured as JSON. `ours` is the run
screen over an engine whose telemetry another process makes (`feed FILE`): force at 1 kHz, poses at 100 Hz and pictures
at 5 Hz. `idle` is an app of textual with a line of text, which asks for nothing and answers the stop key.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

from textual.app import App, ComposeResult
from textual.widgets import Static

from bench.processes import tell

TICK_S = 0.01
READY = "brushloop"
STOPPING_S = 0.15
LOAD = ".load"
"""Suffix of the file that `feed` writes, beside the one for the figures."""


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


class Values:
    """What the rig's telemetry says now, in a file that two processes map: 300 peak forces, tip, picture's number."""

    def __init__(self, file: Path) -> None:
        import numpy as np

        from brushloop.collect.engine.telemetry import TRACE_SLOTS

        self._values = np.memmap(file, np.float64, "r+" if file.exists() else "w+", shape=(TRACE_SLOTS + 4,))

    def put(self, trace_n: tuple[float, ...], tip_mm: tuple[float, float, float], picture: int) -> None:
        """Write all values."""
        self._values[-4:] = (*tip_mm, picture)
        self._values[-4 - len(trace_n) : -4] = trace_n

    def get(self) -> tuple[tuple[float, ...], tuple[float, float, float], int]:
        """Read all values; 0 where none was written yet."""
        *trace_n, x_mm, y_mm, z_mm, picture = self._values.tolist()
        return tuple(trace_n), (x_mm, y_mm, z_mm), int(picture)


def feed(file: Path) -> None:
    """Telemetry at a rig's rates, until the input ends: the load, in a process that nobody is charged for."""
    from brushloop.collect.engine.telemetry import Telemetry
    from brushloop.drivers.samples import ForceSample, Stamp

    telemetry, values, over = Telemetry(), Values(file), threading.Event()

    def run() -> None:
        began = due = time.monotonic()
        for number in itertools.count():
            if over.is_set():
                return
            stamp = Stamp(time.time_ns())
            force_n = 0.03 + 0.02 * (stamp.host_ns // 10**8 % 7)
            telemetry.force(ForceSample(stamp, (0.0, 0.0, force_n), (0, 0, 0)))
            if number % 10 == 0:
                now = time.monotonic()
                tip_mm = (400.0 + 10.0 * (now % 5.0), -45.0, 120.0 + 20.0 * (now % 3.0))
                values.put(telemetry.trace_n(), tip_mm, int((now - began) / 0.2))
            due += 0.001
            time.sleep(max(0.0, due - time.monotonic()))

    thread = threading.Thread(target=run)
    thread.start()
    tell("ready")
    sys.stdin.read()
    over.set()
    thread.join()


def busy_engine(values: Values) -> Any:
    """An engine without an arm whose telemetry comes at a rig's rates."""
    import numpy as np

    from brushloop.collect.engine.control import State
    from brushloop.collect.engine.snapshot import CellCount, Picture, Snapshot
    from brushloop.sessions.records import Condition

    class Busy:
        def __init__(self) -> None:
            self.stops_ns: list[int] = []
            self._stopped_at = -1.0
            self._began = time.monotonic()
            rng = np.random.default_rng(0)
            light = 120.0 + 80.0 * np.linspace(0.0, 1.0, 320)[None, :] * np.linspace(1.0, 0.7, 240)[:, None]
            frames = [light + rng.normal(0.0, 4.0, (240, 320)) for _ in range(5)]
            self._frames = [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]

        def snapshot(self) -> Snapshot:
            now = time.monotonic()
            state = State.STOPPING if now - self._stopped_at < STOPPING_S else State.RUNNING
            trace_n, tip_mm, picture = values.get()
            return Snapshot(
                session_id="bench",
                source="bench",
                state=state,
                step=f"press {int(now) % 30}",
                strokes_done=13,
                strokes_planned=150,
                grid=tuple(
                    CellCount(Condition(float(h), float(a)), 3, 10) for h in (11, 13, 15, 17, 20) for a in (0, 5, 10)
                ),
                voids=0,
                elapsed_s=now - self._began,
                eta_s=100.0,
                tip_mm=tip_mm,
                messages=tuple(f"line {n}" for n in range(50)),
                error="",
                force_n=trace_n[-1],
                target_mm=(410.0, -45.0, 130.0),
                trace_n=trace_n,
                picture=Picture(picture, self._frames[picture % 5], 0.9),
            )

        def stop(self) -> None:
            self.stops_ns.append(time.monotonic_ns())
            self._stopped_at = time.monotonic()

    return Busy()


def main(kind: str, seconds: float, file: Path) -> None:
    """Run one app for so long and write its figures."""
    if kind == "idle":
        idle = Idle()
        figures = measured(idle, seconds)
        stops_ns = idle.stops_ns
    else:
        from brushloop.collect.tui.app import OperatorApp

        engine = busy_engine(Values(file.with_suffix(LOAD)))
        figures = measured(OperatorApp(engine), seconds)
        stops_ns = engine.stops_ns
    file.write_text(json.dumps({**figures, "stops_ns": stops_ns}), encoding="utf-8")


def measured(app: App[None], seconds: float) -> dict[str, Any]:
    """Run the app; CPU of the process and of its screen's thread over `seconds`, and how late its loop came."""
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
    return {**figures, "late_ms": lag.late_ms}


if __name__ == "__main__":
    if sys.argv[1] == "feed":
        feed(Path(sys.argv[2]))
    else:
        main(sys.argv[1], float(sys.argv[2]), Path(sys.argv[3]))
