"""How long the export of many strokes takes in each format."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.harness import Result, machine
from bench.peak import Used, measure
from bench.press_sessions import CLOSE, Presses, session

STROKES = 2000
GOAL_S = 5.0


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Seconds to export `n` strokes (2,000) in each format.

    ratio = for `npz` the goal over ours, for the others npz over ours. Raises BenchError where a command fails,
    ValueError for n < 1.
    """
    strokes = STROKES if n is None else n
    if strokes < 1:
        raise ValueError(f"n = {n}: at least one stroke is needed")
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        many = session(under, "many", Presses(strokes, seed))
        used = {kind: _exported(many, under / "out", kind) for kind in ("npz", "png", "parquet")}
    npz = used["npz"]
    cpu = ", ".join(f"{kind} {one.cpu_s:.1f}" for kind, one in used.items())
    size = f"{CLOSE.width_px} x {CLOSE.height_px} px"
    where = f"loopback rig, {strokes} strokes, photographs of {size} without noise; CPU-s: {cpu}; {machine()}"
    rows = [("npz", npz.wall_s, "s", f"goal {GOAL_S:g} s at most for 2,000 strokes", GOAL_S / npz.wall_s)]
    rows += [(kind, one.wall_s, "s", "npz", npz.wall_s / one.wall_s) for kind, one in used.items() if kind != "npz"]
    return [
        Result(f"export.{name}", value, unit, peer, ratio, 1, seed, where) for name, value, unit, peer, ratio in rows
    ]


def _exported(place: Path, out: Path, kind: str) -> Used:
    used = measure(sys.executable, "-m", "brushloop", "sessions", "export", str(place), str(out), "--format", kind)
    shutil.rmtree(out)
    return used
