"""The operator's app under a rig's load, beside an idle app of textual, each in a terminal of its own.

Force comes at 1 kHz, poses at 100 Hz, camera pictures at 5 Hz, on a terminal of 120 x 40.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import statistics
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

from bench.harness import BenchError, Result, machine, percentile
from bench.processes import started
from bench.tui_process import LOAD

ROOT = Path(__file__).resolve().parent.parent
COLUMNS, ROWS = 120, 40
SECONDS = 10.0
UI_PERCENT = 8.0
"""What the thread of the screen may take of a core under this load."""
WAIT_S = 60.0
READY = {"ours": b"RUNNING", "idle": b"brushloop"}
STOPPED = (b"STOP SENT", b"STOPPING")
"""Either shows the operator that the key was noticed."""
PRESS_EVERY_S = 0.4


@dataclass(frozen=True)
class Measured:
    """One app, run once."""

    first_paint_s: float
    seconds: dict[str, float]
    """CPU of the process and of its screen's thread, and the wall's time, over the same span."""
    times_ms: dict[str, list[float]]
    """Lag of the loop, key to stop, key to screen."""


def run(*, n: int | None = None, seed: int = 0) -> list[Result]:
    """CPU share, lag of the loop, key to stop, key to screen, first paint: `n` runs (3) of each app in turns.

    The seed changes nothing. Raises BenchError where an app does not come up, ValueError for n < 1.
    """
    rounds = 3 if n is None else n
    if rounds < 1:
        raise ValueError(f"n = {rounds}: at least one round is needed")
    ours: list[Measured] = []
    idle: list[Measured] = []
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(rounds):
            ours.append(_measured("ours", Path(scratch) / f"ours-{number}"))
            idle.append(_measured("idle", Path(scratch) / f"idle-{number}"))
    conditions = f"{machine()}; {COLUMNS} x {ROWS}, force 1 kHz, poses 100 Hz, pictures 5 Hz"

    def result(name: str, unit: str, value: float, peer: str, peer_value: float) -> Result:
        ratio = peer_value / value if value > 0 else float("inf")
        return Result(f"tui-{name}", value, unit, f"{peer} ({peer_value:.3g} {unit})", ratio, rounds, seed, conditions)

    def p(percent: float, runs: list[Measured], name: str) -> float:
        return percentile([value for one in runs for value in one.times_ms[name]], percent)

    idle_app = "an idle textual app"
    return [
        result("cpu", "% of a core", _share(ours, "process_s"), idle_app, _share(idle, "process_s")),
        result("cpu-ui-thread", "% of a core", _share(ours, "ui_s"), idle_app, _share(idle, "ui_s")),
        Result(
            "tui-cpu-ui-thread-goal",
            _share(ours, "ui_s"),
            "% of a core",
            f"goal {UI_PERCENT:g} % at most",
            UI_PERCENT / _share(ours, "ui_s"),
            rounds,
            seed,
            conditions,
        ),
        result("lag-p99", "ms", p(99, ours, "lag"), idle_app, p(99, idle, "lag")),
        result("key-to-stop-p50", "ms", p(50, ours, "to stop"), idle_app, p(50, idle, "to stop")),
        result("key-to-stop-p99", "ms", p(99, ours, "to stop"), idle_app, p(99, idle, "to stop")),
        result("key-to-screen-p50", "ms", p(50, ours, "to screen"), idle_app, p(50, idle, "to screen")),
        result("key-to-screen-p99", "ms", p(99, ours, "to screen"), idle_app, p(99, idle, "to screen")),
        result(
            "first-paint",
            "s",
            statistics.median(one.first_paint_s for one in ours),
            "textual's own blank app",
            statistics.median(one.first_paint_s for one in idle),
        ),
    ]


def _share(runs: list[Measured], name: str) -> float:
    return statistics.median(100.0 * one.seconds[name] / one.seconds["wall_s"] for one in runs)


def _measured(kind: str, file: Path) -> Measured:
    feeding = started("bench.tui_process", "feed", str(file.with_suffix(LOAD))) if kind == "ours" else nullcontext()
    with feeding, _terminal() as (ours, theirs):
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "bench.tui_process", kind, str(SECONDS), str(file)],
            cwd=ROOT,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            env={**os.environ, "TERM": "xterm-256color", "COLORTERM": "truecolor"},
        )
        try:
            _read_until(ours, (READY[kind],), process)
            painted = time.monotonic() - began
            pressed_ns, to_screen = _press(ours, process)
            while process.poll() is None and time.monotonic() - began < WAIT_S:
                _drain(ours, 0.05)
            if process.poll() != 0:
                raise BenchError(f"the app `{kind}` ended with {process.poll()}")
        finally:
            process.kill()
            process.wait()
    figures = json.loads(file.read_text(encoding="utf-8"))
    seconds = {name: float(figures[name]) for name in ("wall_s", "process_s", "ui_s")}
    to_stop = [(b - a) / 1e6 for a, b in zip(pressed_ns, figures["stops_ns"], strict=True)]
    return Measured(painted, seconds, {"lag": figures["late_ms"], "to stop": to_stop, "to screen": to_screen})


def _press(terminal: int, process: subprocess.Popen[bytes]) -> tuple[list[int], list[float]]:
    pressed_ns: list[int] = []
    to_screen: list[float] = []
    until = time.monotonic() + 0.8 * SECONDS
    _drain(terminal, 1.0)
    while time.monotonic() < until:
        _drain(terminal, PRESS_EVERY_S)
        pressed_ns.append(time.monotonic_ns())
        os.write(terminal, b"s")
        _read_until(terminal, STOPPED, process)
        to_screen.append((time.monotonic_ns() - pressed_ns[-1]) / 1e6)
    return pressed_ns, to_screen


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
