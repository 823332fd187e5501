"""What a person waits for between collecting and the report: the start of a command, `fit` and `validate`.

30 presses of the simulated brush (loopback rig), photographed at 10 px/mm and imported. Each figure is beside its
goal, and is of a whole command in a process of its own: CPU seconds of all cores, for `validate` those of a clock.
"""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench.harness import BenchError, Result, machine
from bench.validate import Presses, session

ROOT = Path(__file__).resolve().parent.parent
PRESSES = 30
FIT_CPU_S, VALIDATE_S, START_S = 8.0, 10.0, 0.8
"""The goals, on two quiet cores."""
STARTED = ("calibrate", "fit", "validate")
"""Commands that are timed up to the refusal of a session that does not exist: all that comes before the work."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """The median of `n` runs of each command, default 3. ratio = goal over ours. Raises BenchError if one fails."""
    rounds = 3 if n is None else n
    if rounds < 1:
        raise ValueError(f"n = {rounds}: at least one round is needed")
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        place = session(under, "presses", Presses(PRESSES, seed))
        starts = [_timed(name, "nowhere", code=2)[1] for _ in range(rounds) for name in STARTED]
        fits = [_timed("fit", str(place))[1] for _ in range(rounds)]
        reports = [_timed("validate", str(place), "--out", str(under / f"report-{k}")) for k in range(rounds)]
    busy_s = statistics.median(cpu_s for _, cpu_s in reports)
    where = f"loopback rig, {PRESSES} presses; validate used {busy_s:.1f} CPU-s; {machine()}"
    return [
        _result("start", starts, "CPU-s", f"{START_S:g} s before work begins", START_S, seed, where),
        _result("fit", fits, "CPU-s", f"{FIT_CPU_S:g} CPU-s", FIT_CPU_S, seed, where),
        _result("validate", [wall_s for wall_s, _ in reports], "s", f"{VALIDATE_S:g} s", VALIDATE_S, seed, where),
    ]


def _result(name: str, found: list[float], unit: str, goal: str, most: float, seed: int, where: str) -> Result:
    value = statistics.median(found)
    return Result(f"analysis.{name}", value, unit, f"goal {goal} at most", most / value, len(found), seed, where)


def _timed(*words: str, code: int = 0) -> tuple[float, float]:
    """(seconds, seconds of all cores) of one command. Raises BenchError if its exit code is another."""
    began, before = time.perf_counter(), _children_s()
    command = [sys.executable, "-m", "brushloop", *words]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    if ran.returncode != code:
        raise BenchError(f"`brushloop {' '.join(words)}` ended with {ran.returncode}: {ran.stderr[-200:]}")
    return time.perf_counter() - began, _children_s() - before


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
