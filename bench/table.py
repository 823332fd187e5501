"""The figures of all benches as one Markdown table, kept in docs/bench.md so that a regression shows in a diff."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from pathlib import Path

from bench.harness import Result, machine

OUT = Path(__file__).resolve().parent.parent / "docs" / "bench.md"
GOALS = {
    "raster-press": 40.0,
    "raster-press-bulk": 40.0,
    "raster-press-memset": 0.45,
    "raster-press-bulk-memset": 0.45,
    "recorder write rate": 0.8,
    "recorder write rate per CPU second": 0.8,
}
"""The ratio that was asked for, by figure."""
_HEAD = """# Figures of the benches
Written by `make bench` (speed and memory, about 12 minutes), `python -m bench --accuracy --table` (hours),
or `python -m bench NAME --table`, which renews the rows of one bench.

A ratio compares with the peer or limit named beside it, in the same run; above 1 is better for us. Figures of strokes
and photographs are of the loopback rig, which is simulated. Each row says when it was measured.
"""
_COLUMNS = (
    "| figure | value | ratio | quickest tenth, median | peer or limit | goal | n | seed | machine | measured |",
    "|---|---|---|---|---|---|---|---|---|---|",
)
MISSED = "**missed**"


def renew(results: Sequence[Result], path: Path = OUT) -> None:
    """Write the rows of `results`; rows of figures that were not measured now stay as they are."""
    kept = path.read_text().splitlines() if path.exists() else []
    rows = {name_of(line): line for line in kept if line.startswith("| `")}
    rows |= {result.name: row(result) for result in results}
    table = [rows[name] for name in sorted(rows)]
    failed = ", ".join(f"`{name_of(line)}`" for line in table if MISSED in line)
    words = f"**Goals that are missed:** {failed}." if failed else "No goal is missed."
    path.write_text("\n".join([_HEAD, words, "", *_COLUMNS, *table, ""]))


def missed(path: Path = OUT) -> list[str]:
    """The figures whose goal is missed."""
    return [name_of(line) for line in path.read_text().splitlines() if line.startswith("| `") and MISSED in line]


def name_of(line: str) -> str:
    """The figure that a row of the table is about."""
    return line.split("`")[1]


def row(result: Result) -> str:
    """One row; a goal that is missed says so."""
    goal = _goal(result)
    asked = "" if goal is None else f"{goal:g}" if result.ratio >= goal else f"{goal:g}, {MISSED}"
    both = "" if result.quickest is None else f"{result.quickest:.2f}, {result.median:.2f}"
    value = f"{result.value:,.0f}" if result.value >= 1000 else f"{result.value:.3g}"
    cells = (f"`{result.name}`", f"{value} {result.unit}", f"{result.ratio:.2f}", both, result.peer, asked,
             str(result.n), str(result.seed), machine(), str(dt.date.today()))  # fmt: skip
    return f"| {' | '.join(cells)} |"


def _goal(result: Result) -> float | None:
    """The ratio that was asked for; 1 where the peer is itself a goal or a limit."""
    if result.name in GOALS:
        return GOALS[result.name]
    return 1.0 if "goal" in result.peer or result.name.endswith("-memory") else None
