"""`bench tui`: the operator's app under a rig's load: force at 1 kHz, poses at 100 Hz, camera pictures at 5 Hz.

The app runs without a terminal, in a process of its own (`python -m bench.tui`), of which a thread makes the telemetry,
as the drivers' threads do.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import statistics
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from bench.harness import ROOT, BenchError, Result, at_most, machine, rounds_of, tell
from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import TRACE_SLOTS, ConditionCount, Picture, Snapshot
from brushloop.collect.tui.app import OperatorApp
from brushloop.sessions.records import Condition

SIZE = (120, 40)
SECONDS, TICK_S, STOPPING_S, PRESS_EVERY_S = 10.0, 0.01, 0.15, 0.4
UI_PERCENT, STOP_MS, LAG_MS = 8.0, 5.0, 20.0
"""The goals: CPU of the screen's thread as a share of a core, stop key to `engine.stop`, lag of the app's loop."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """CPU of the screen's thread, lag of its loop, and stop key to engine: `n` runs (3). The seed changes nothing."""
    rounds = rounds_of(n, 3)
    runs = [_measured() for _ in range(rounds)]
    where = f"{machine()}; {SIZE[0]} x {SIZE[1]}, force 1 kHz, poses 100 Hz, pictures 5 Hz"

    def p99(name: str) -> float:
        return float(np.percentile([value for one in runs for value in one[name]], 99))

    ui_percent = statistics.median(one["ui_percent"] for one in runs)
    return [
        at_most("tui-cpu-ui-thread", ui_percent, "% of a core", UI_PERCENT, rounds, seed, where),
        at_most("tui-lag-p99", p99("lag_ms"), "ms", LAG_MS, rounds, seed, where),
        at_most("tui-key-to-stop-p99", p99("to_stop_ms"), "ms", STOP_MS, rounds, seed, where),
    ]


def _measured() -> dict[str, Any]:
    command = [sys.executable, "-m", "bench.tui"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=20 * SECONDS)
    if ran.returncode != 0:
        raise BenchError(f"the app ended with {ran.returncode}: {ran.stderr.strip()[-300:]}")
    return json.loads(ran.stdout)


class BusyEngine:
    """An engine without an arm, whose telemetry comes at a rig's rates until the process ends."""

    def __init__(self) -> None:
        self.stops_ns: list[int] = []
        self._stopped_at = -1.0
        self._began = time.monotonic()
        self._peaks_n = deque[float](maxlen=TRACE_SLOTS)
        rng = np.random.default_rng(0)
        light = 120.0 + 80.0 * np.linspace(0.0, 1.0, 320)[None, :] * np.linspace(1.0, 0.7, 240)[:, None]
        frames = [light + rng.normal(0.0, 4.0, (240, 320)) for _ in range(5)]
        self._frames = [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]
        threading.Thread(target=self._feed, name="telemetry", daemon=True).start()

    def _feed(self) -> None:
        due = time.monotonic()
        for number in itertools.count():
            force_n = 0.03 + 0.02 * (number // 100 % 7)
            if number % 100 == 0:
                self._peaks_n.append(force_n)
            due += 0.001
            time.sleep(max(0.0, due - time.monotonic()))

    def snapshot(self) -> Snapshot:
        """The state of a run in its middle, the tip on its way."""
        now = time.monotonic()
        trace_n, picture = tuple(self._peaks_n), int((now - self._began) / 0.2)
        return Snapshot(
            session_id="bench",
            source="bench",
            state=State.STOPPING if now - self._stopped_at < STOPPING_S else State.RUNNING,
            step=f"press {int(now) % 30}",
            strokes_done=13,
            strokes_planned=150,
            grid=tuple(
                ConditionCount(Condition(float(h), float(a)), 3, 10) for h in (11, 13, 15, 17, 20) for a in (0, 5, 10)
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
            picture=Picture(self._frames[picture % 5], 0.9),
        )

    def stop(self) -> None:
        """Note the time."""
        self.stops_ns.append(time.monotonic_ns())
        self._stopped_at = time.monotonic()


async def main() -> None:
    """Run the app for `SECONDS`, press the stop key now and then, and print what was measured as JSON."""
    engine: Any = BusyEngine()
    app = OperatorApp(lambda _: engine, engine)
    lag_ms: list[float] = []
    to_stop_ms: list[float] = []

    async def watch() -> None:
        while True:
            due = time.perf_counter() + TICK_S
            await asyncio.sleep(TICK_S)
            lag_ms.append(1e3 * (time.perf_counter() - due))

    async with app.run_test(size=SIZE) as pilot:
        await asyncio.sleep(1.0)  # past its start
        watching = asyncio.create_task(watch())
        wall_s, thread_s = time.perf_counter(), time.thread_time()
        while time.perf_counter() - wall_s < SECONDS:
            pressed_ns = time.monotonic_ns()
            await pilot.press("s")
            to_stop_ms.append((engine.stops_ns[-1] - pressed_ns) / 1e6)
            await asyncio.sleep(PRESS_EVERY_S)
        used = (time.thread_time() - thread_s) / (time.perf_counter() - wall_s)
        watching.cancel()
    tell(json.dumps({"ui_percent": 100.0 * used, "lag_ms": lag_ms, "to_stop_ms": to_stop_ms}))


if __name__ == "__main__":
    asyncio.run(main())
