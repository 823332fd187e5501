"""`bench tui`: the operator's app under a rig's load, in a terminal of its own.

Force comes at 1 kHz, poses at 100 Hz, camera pictures at 5 Hz, on a terminal of 120 x 40. A thread of the same process
makes them, as the drivers' threads do; `python -m bench.tui FILE` is that process, which writes what it measured.
"""

from __future__ import annotations

import asyncio
import fcntl
import itertools
import json
import os
import select
import statistics
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness import ROOT, BenchError, Result, at_most, machine, percentile, rounds_of
from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import CellCount, Picture, Snapshot
from brushloop.collect.engine.telemetry import Telemetry
from brushloop.collect.tui.app import OperatorApp
from brushloop.drivers.samples import ForceSample, Stamp
from brushloop.sessions.records import Condition

COLUMNS, ROWS = 120, 40
SECONDS, TICK_S, STOPPING_S, PRESS_EVERY_S, WAIT_S = 10.0, 0.01, 0.15, 0.4, 60.0
UI_PERCENT, STOP_MS, SCREEN_MS, LAG_MS, PAINT_S = 8.0, 5.0, 50.0, 20.0, 1.0
"""The goals: share of a core, key to `engine.stop`, key to the screen, lag of the loop, and time to the first paint."""
STOPPED = (b"STOP SENT", b"STOPPING")
"""Either shows the operator that the key was noticed."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One run of the app."""

    first_paint_s: float
    ui_percent: float
    """CPU of the screen's thread, of a core."""
    lag_ms: list[float]
    to_stop_ms: list[float]
    to_screen_ms: list[float]


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """CPU of the screen's thread, lag of its loop, key to stop, key to screen, first paint: `n` runs (3).

    The seed changes nothing. Raises BenchError where the app does not come up.
    """
    rounds = rounds_of(n, 3)
    with tempfile.TemporaryDirectory() as scratch:
        runs = [_measured(Path(scratch) / str(number)) for number in range(rounds)]
    where = f"{machine()}; {COLUMNS} x {ROWS}, force 1 kHz, poses 100 Hz, pictures 5 Hz"

    def p99(values: Callable[[Measured], list[float]]) -> float:
        return percentile([value for one in runs for value in values(one)], 99)

    figures = (
        ("tui-cpu-ui-thread", statistics.median(one.ui_percent for one in runs), "% of a core", UI_PERCENT),
        ("tui-lag-p99", p99(lambda one: one.lag_ms), "ms", LAG_MS),
        ("tui-key-to-stop-p99", p99(lambda one: one.to_stop_ms), "ms", STOP_MS),
        ("tui-key-to-screen-p99", p99(lambda one: one.to_screen_ms), "ms", SCREEN_MS),
        ("tui-first-paint", statistics.median(one.first_paint_s for one in runs), "s", PAINT_S),
    )
    return [at_most(name, value, unit, goal, rounds, seed, where) for name, value, unit, goal in figures]


def _measured(file: Path) -> Measured:
    with _terminal() as (ours, theirs):
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "bench.tui", str(file)],
            cwd=ROOT,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "TERM": "xterm-256color", "COLORTERM": "truecolor"},
        )
        try:
            _read_until(ours, (b"RUNNING",), process)
            painted_s = time.monotonic() - began
            pressed_ns, to_screen_ms = _press(ours, process)
            while process.poll() is None and time.monotonic() - began < WAIT_S:
                _drain(ours, 0.05)
            if process.poll() != 0:
                raise BenchError(f"the app ended with {process.poll()}")
        finally:
            process.kill()
            process.wait()
    figures = json.loads(file.read_text(encoding="utf-8"))
    to_stop_ms = [(b - a) / 1e6 for a, b in zip(pressed_ns, figures["stops_ns"], strict=True)]
    return Measured(painted_s, figures["ui_percent"], figures["lag_ms"], to_stop_ms, to_screen_ms)


def _press(terminal: int, process: subprocess.Popen[bytes]) -> tuple[list[int], list[float]]:
    """When the stop key was pressed, and how long it took until the screen showed it, ms."""
    pressed_ns: list[int] = []
    to_screen_ms: list[float] = []
    until = time.monotonic() + 0.8 * SECONDS
    _drain(terminal, 1.0)
    while time.monotonic() < until:
        _drain(terminal, PRESS_EVERY_S)
        pressed_ns.append(time.monotonic_ns())
        os.write(terminal, b"s")
        _read_until(terminal, STOPPED, process)
        to_screen_ms.append((time.monotonic_ns() - pressed_ns[-1]) / 1e6)
    return pressed_ns, to_screen_ms


def _read_until(terminal: int, words: tuple[bytes, ...], process: subprocess.Popen[bytes]) -> None:
    seen, deadline = b"", time.monotonic() + WAIT_S
    while not any(word in seen for word in words):
        if time.monotonic() > deadline or process.poll() is not None:
            raise BenchError(f"{words[0].decode()!r} was never shown")
        if select.select([terminal], [], [], 0.05)[0]:
            seen = (seen + os.read(terminal, 65536))[-200_000:]


def _drain(terminal: int, seconds: float) -> None:
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        if select.select([terminal], [], [], left)[0]:
            with suppress(OSError):
                os.read(terminal, 65536)


@contextmanager
def _terminal() -> Iterator[tuple[int, int]]:
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    try:
        yield ours, theirs
    finally:
        os.close(ours)
        os.close(theirs)


class BusyEngine:
    """An engine without an arm, whose telemetry comes at a rig's rates until the process ends."""

    def __init__(self) -> None:
        self.stops_ns: list[int] = []
        self._stopped_at = -1.0
        self._began = time.monotonic()
        self._telemetry = Telemetry()
        rng = np.random.default_rng(0)
        light = 120.0 + 80.0 * np.linspace(0.0, 1.0, 320)[None, :] * np.linspace(1.0, 0.7, 240)[:, None]
        frames = [light + rng.normal(0.0, 4.0, (240, 320)) for _ in range(5)]
        self._frames = [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]
        threading.Thread(target=self._feed, name="telemetry", daemon=True).start()

    def _feed(self) -> None:
        due = time.monotonic()
        for number in itertools.count():
            force_n = 0.03 + 0.02 * (number // 100 % 7)
            self._telemetry.force(ForceSample(Stamp(time.time_ns()), (0.0, 0.0, force_n), (0, 0, 0)))
            due += 0.001
            time.sleep(max(0.0, due - time.monotonic()))

    def snapshot(self) -> Snapshot:
        """The state of a run in its middle, the tip on its way."""
        now = time.monotonic()
        trace_n, picture = self._telemetry.trace_n(), int((now - self._began) / 0.2)
        return Snapshot(
            session_id="bench",
            source="bench",
            state=State.STOPPING if now - self._stopped_at < STOPPING_S else State.RUNNING,
            step=f"press {int(now) % 30}",
            strokes_done=13,
            strokes_planned=150,
            grid=tuple(
                CellCount(Condition(float(h), float(a)), 3, 10) for h in (11, 13, 15, 17, 20) for a in (0, 5, 10)
            ),
            voids=0,
            elapsed_s=now - self._began,
            eta_s=100.0,
            tip_mm=(400.0 + 10.0 * (now % 5.0), -45.0, 120.0 + 20.0 * (now % 3.0)),
            messages=tuple(f"line {n}" for n in range(50)),
            error="",
            force_n=trace_n[-1] if trace_n else 0.0,
            target_mm=(410.0, -45.0, 130.0),
            trace_n=trace_n,
            picture=Picture(picture, self._frames[picture % 5], 0.9),
        )

    def stop(self) -> None:
        """Note the time."""
        self.stops_ns.append(time.monotonic_ns())
        self._stopped_at = time.monotonic()


def main(file: Path) -> None:
    """Run the app for `SECONDS` and write its figures."""
    engine: Any = BusyEngine()
    app = OperatorApp(engine)
    lag_ms: list[float] = []
    figures: dict[str, float] = {}

    async def watch() -> None:
        while True:
            due = time.perf_counter() + TICK_S
            await asyncio.sleep(TICK_S)
            lag_ms.append(1e3 * (time.perf_counter() - due))

    async def measure() -> None:
        watching = asyncio.create_task(watch())
        await asyncio.sleep(1.0)  # past its start
        lag_ms.clear()
        wall_s, thread_s = time.perf_counter(), time.thread_time()
        await asyncio.sleep(SECONDS)
        figures["ui_percent"] = 100.0 * (time.thread_time() - thread_s) / (time.perf_counter() - wall_s)
        watching.cancel()
        app.exit()

    app.call_later(lambda: app.run_worker(measure()))
    app.run()
    file.write_text(json.dumps({**figures, "lag_ms": lag_ms, "stops_ns": engine.stops_ns}), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
