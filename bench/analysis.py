"""What a person waits for between collecting and the report: `fit` and `validate`.

30 presses of the simulated brush (loopback rig), photographed at 10 px/mm and imported. Each figure stands
beside its goal and is that of a whole command in a process of its own: CPU seconds of all cores, for `validate`
wall-clock seconds.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.harness import Result, machine
from bench.peak import measure
from bench.press_sessions import Presses, session

PRESSES = 30
FIT_CPU_S, VALIDATE_S = 8.0, 10.0
"""The goals, on two quiet cores."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """The median of `n` runs of each command, default 3. ratio = goal over ours. Raises BenchError if one fails."""
    rounds = 3 if n is None else n
    if rounds < 1:
        raise ValueError(f"n = {rounds}: at least one round is needed")
    brushloop = (sys.executable, "-m", "brushloop")
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        place = str(session(under, "presses", Presses(PRESSES, seed)))
        fits = [measure(*brushloop, "fit", place) for _ in range(rounds)]
        reports = [measure(*brushloop, "validate", place, "--out", str(under / f"{k}")) for k in range(rounds)]
    busy_s = statistics.median(used.cpu_s for used in reports)
    where = f"loopback rig, {PRESSES} presses; validate used {busy_s:.1f} CPU-s; {machine()}"
    fit_s, validate_s = (statistics.median(found) for found in ([u.cpu_s for u in fits], [u.wall_s for u in reports]))
    return [
        Result(
            "analysis.fit", fit_s, "CPU-s", f"goal {FIT_CPU_S:g} CPU-s at most", FIT_CPU_S / fit_s, rounds, seed, where
        ),
        Result(
            "analysis.validate",
            validate_s,
            "s",
            f"goal {VALIDATE_S:g} s at most",
            VALIDATE_S / validate_s,
            rounds,
            seed,
            where,
        ),
    ]
