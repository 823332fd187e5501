"""The loop closed on frozen brushes: re-pressed strokes against the brush's own repeatability; loopback rig.

The brushes are those of `bench.brushfit_brushes`, frozen before any score was looked at. Each is collected, fitted,
recovered and pressed again by the commands that an operator would use, on a rig in a process of its own.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.brushfit_brushes import FROZEN
from bench.harness import Result, machine
from bench.processes import brushloop, started

HEIGHTS_MM = [11.0, 15.0, 20.0]
TILTS_DEG = [0.0, 5.0, 10.0]
REPEATS = 3
RATE = 20.0
GOAL_POINTS = 1.0
ENDS = (0, 3)
"""3 is a collection that finished without some strokes; fewer pairs are named in the result."""


def run(*, n: int | None = None, seed: int = 1) -> Sequence[Result]:
    """Re-pressed minus another press, in points, of the first `n` frozen brushes (default two): the least and the mean
    of eight comparisons each (two alignments, two tones, CSIM and SSIM). 27 presses, 27 again, about 4 minutes a brush.

    ratio = the goal (1 point less) over the points that are lost. Raises BenchError where a command fails.
    """
    brushes = 2 if n is None else n
    if not 1 <= brushes <= len(FROZEN):
        raise ValueError(f"n = {brushes}: 1 to {len(FROZEN)} brushes")
    results: list[Result] = []
    for brush in range(brushes):
        with tempfile.TemporaryDirectory() as scratch:
            outcome = close_the_loop(Path(scratch), brush, seed)
        lost = [-verdict["difference"] for verdict in outcome["verdicts"]]
        conditions = (
            f"{outcome['source']}, {outcome['pairs']} pairs, {len(outcome['refused'])} not compared; {machine()}"
        )
        for name, points in (("worst of 8", max(lost)), ("mean of 8", sum(lost) / len(lost))):
            peer = f"the goal ({GOAL_POINTS:g} point)"
            ratio = GOAL_POINTS / max(points, 0.01)
            title = f"loop: brush {brush + 1}, {name}"
            results.append(Result(title, points, "points lost", peer, ratio, outcome["pairs"], seed, conditions))
    return results


def close_the_loop(folder: Path, brush: int, seed: int) -> dict[str, Any]:
    """Collect a grid, run `brushloop loop`; returns its loop.json."""
    rig, protocol, sessions = folder / "rig.toml", folder / "protocol.toml", folder / "sessions"
    grid = f'kind = "grid"\ndepths_mm = {HEIGHTS_MM}\ntilts_deg = {TILTS_DEG}\nrepeats = {REPEATS}\nseed = {seed}\n'
    protocol.write_text(grid, encoding="utf-8")
    with started("bench.loop_rig", str(rig), str(brush), str(RATE)) as process:
        brushloop("collect", "--config", rig, "--protocol", protocol, "--out", sessions, "--no-tui", ends=ENDS)
        [session] = sessions.iterdir()
        process.ask()
        brushloop("loop", session, "--config", rig, "--sheet", "1", "--no-tui", "--seed", str(seed), ends=ENDS)
    return json.loads((session / "loop" / "loop.json").read_text(encoding="utf-8"))
