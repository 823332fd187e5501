"""Many benches one after the other, each in a process of its own: `python -m bench`, `python -m bench --accuracy`.

A bench that fails, hangs or exhausts memory costs its own figures only.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SPEED = {
    "startup": 40,
    "analysis": 60,
    "overhead": 130,
    "recorder": 60,
    "tui": 80,
    "raster": 60,
    "validate": 100,
}
"""What `make bench` measures, and about how many seconds each bench takes on two quiet cores."""
ACCURACY = {
    "quality": 300,
    "paper-brush": 120,
    "inversion": 300,
    "loop": 600,
    "realink": 900,
    "written": 1300,
    "brushfit": 1800,
    "twin": 2400,
}
"""What takes longer, because it trains, fits or presses: how good the results are, rather than how quick."""
MOST_TIMES, MORE_S = 6, 180
"""A bench is given up after its usual seconds times the first number, plus the second."""


def run_all(plan: Mapping[str, int], options: Sequence[str], say: Callable[[str], None]) -> list[str]:
    """Run `python -m bench NAME` with `options` for each bench of `plan`; return those that were not measured."""
    began, whole_s, failed = time.monotonic(), sum(plan.values()), list[str]()
    before_s = 0
    for number, (name, about_s) in enumerate(plan.items(), 1):
        share, left_min = 100 * about_s / whole_s, (whole_s - before_s) / 60
        say(
            f"[{number} of {len(plan)}] {name}: about {about_s} s ({share:.0f} % of all), about {left_min:.0f} min left"
        )
        if why := _failure([sys.executable, "-m", "bench", name, *options], MOST_TIMES * about_s + MORE_S):
            say(f"{name}: not measured: {why}")
            failed.append(name)
        before_s += about_s
    say(f"{len(plan) - len(failed)} of {len(plan)} benches measured in {(time.monotonic() - began) / 60:.1f} min")
    return failed


def _failure(command: Sequence[str], most_s: float) -> str:
    """Run a command; return why it failed, or nothing."""
    try:
        ran = subprocess.run(command, cwd=ROOT, check=False, timeout=most_s)
    except subprocess.TimeoutExpired:
        return f"it was ended after {most_s:.0f} s"
    return f"it ended with {ran.returncode}" if ran.returncode else ""
