"""`python -m bench [NAME] [-n N] [--json] [--table]`: run one benchmark, or many, and print a line for each figure.

Without NAME, those of speed and memory (about 25 minutes), or with --accuracy those that train, fit and press (hours),
each in a process of its own: a bench that fails, hangs or exhausts memory costs its own figures only. With --table,
docs/results.md gets the figures as well.

Exit codes: 0 measured, 1 a benchmark could not be measured, 2 unknown name.
"""

from __future__ import annotations

import argparse
import datetime as dt
import importlib
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from bench.harness import ROOT, BenchError, Result, machine

SPEED = {
    "startup": ("commands.startup", 40),
    "analysis": ("commands.analysis", 90),
    "report": ("commands.report", 480),
    "demo": ("commands.demo", 240),
    "overhead": ("overhead.run", 130),
    "recorder": ("recorder.run", 60),
    "tui": ("tui.run", 60),
    "raster": ("images.raster", 60),
    "inversion": ("images.inversion", 30),
    "quality": ("quality.run", 300),
}
"""What `make bench` measures: module and function, and about how many seconds each takes on two quiet cores."""
ACCURACY = {
    "fit": ("accuracy.fit", 600),
    "few": ("accuracy.few", 900),
    "intervals": ("accuracy.intervals", 600),
    "table2-brush": ("accuracy.table2_brush", 120),
    "drags": ("accuracy.drags", 900),
    "loop": ("accuracy.loop", 600),
    "written": ("accuracy.written", 5400),
    "twin": ("accuracy.twin", 2400),
}
"""How good the results are, rather than how quick."""
BENCHES = SPEED | ACCURACY
MOST_TIMES, MORE_S = 6, 180
"""A bench is given up after its usual seconds times the first number, plus the second."""
OUT = ROOT / "docs" / "results.md"
GOALS = {
    "raster-press": 40.0,
    "recorder write rate": 0.8,
}
"""The ratio that was asked for, by figure, where the peer is not itself a goal."""
MISSED = "**missed**"
HEAD = """# Measured results
Written by the benches: `make bench` (speed and memory, about 25 minutes), `python -m bench --accuracy --table` (hours),
or `python -m bench NAME --table`, which renews the rows of one bench. A ratio compares with the peer or goal named
beside it, in the same run; above 1 is better for us. All ink is that of the loopback rig or of another simulation, but
for `drags`, which are real strokes. `conditions` are those of the run, with the load of the machine.
"""
COLUMNS = (
    "| figure | value | ratio | peer or goal | asked | n | seed | conditions | measured |",
    "|---|---|---|---|---|---|---|---|---|",
)


def bench_of(name: str) -> Callable[..., Sequence[Result]]:
    """The benchmark of that name: a function of `n` rounds, strokes or brushes (None: its default) and a `seed`.

    What it needs is imported when it is asked for. It raises BenchError where it cannot measure, ValueError for n < 1.
    """
    module, _, function = BENCHES[name][0].partition(".")
    return getattr(importlib.import_module(f"bench.{module}"), function)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench", description="Measure this project beside its peers.")
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"one of {', '.join(BENCHES)}")
    parser.add_argument("--accuracy", action="store_true", help=f"without NAME: {', '.join(ACCURACY)}; hours")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--table", action="store_true", help=f"renew the figures' rows in docs/{OUT.name}")
    parser.add_argument("-n", type=int, help="rounds, strokes or brushes, with NAME")
    options = parser.parse_args(arguments)
    if options.name is None:
        words = [word for word, wanted in (("--json", options.json), ("--table", options.table)) if wanted]
        return _run_all(list(ACCURACY if options.accuracy else SPEED), words)
    if options.name not in BENCHES:
        print(f"unknown bench {options.name!r}; known: {', '.join(BENCHES)}", file=sys.stderr)
        return 2
    try:
        results = bench_of(options.name)(n=options.n)
    except BenchError as error:
        print(f"{options.name}: {error}", file=sys.stderr)
        return 1
    if options.table:
        renew(options.name, results)
    for before, result in zip([None, *results], results, strict=False):
        if not options.json and result.conditions and (before is None or before.conditions != result.conditions):
            print(f"# {result.conditions}")
        print(result.to_json() if options.json else result.to_line(), flush=True)
    return 0


def _run_all(names: Sequence[str], words: Sequence[str]) -> int:
    """Run these benches with these options; progress, and what failed, go to stderr. Returns the exit code."""
    failed, left_s = list[str](), sum(BENCHES[name][1] for name in names)
    for number, name in enumerate(names, 1):
        about_s = BENCHES[name][1]
        print(f"[{number} of {len(names)}] {name}: about {about_s} s, {left_s / 60:.0f} min left", file=sys.stderr)
        left_s -= about_s
        command, most_s = [sys.executable, "-m", "bench", name, *words], MOST_TIMES * about_s + MORE_S
        began = time.monotonic()
        try:
            ended = subprocess.run(command, cwd=ROOT, check=False, timeout=most_s).returncode
        except subprocess.TimeoutExpired:
            ended = None
        if ended != 0:
            why = "was stopped" if ended is None else f"ended with {ended}"
            print(f"{name}: not measured: it {why} after {time.monotonic() - began:.0f} s", file=sys.stderr)
            failed.append(name)
    return 1 if failed else 0


def renew(bench: str, results: Sequence[Result], path: Path = OUT) -> None:
    """Write the figures of one bench into the page; those of other benches stay as they are."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    tables = {part.split("\n", 1)[0]: part for part in text.split("\n## ")[1:]}
    rows = [row(result) for result in results]
    tables[bench] = "\n".join([bench, *COLUMNS, *rows])
    parts = [tables[name].rstrip("\n") for name in BENCHES if name in tables]
    missed = [line.split("`")[1] for part in parts for line in part.splitlines() if MISSED in line]
    words = f"**Goals that are missed:** {', '.join(f'`{name}`' for name in missed)}." if missed else "None is missed."
    path.write_text("\n## ".join([f"{HEAD}\n{words}\n", *(f"{part}\n" for part in parts)]), encoding="utf-8")


def row(result: Result) -> str:
    """One row of the page; a goal that is missed says so. A peer that is a goal asks for a ratio of 1."""
    goal = GOALS.get(result.name, 1.0 if "goal" in result.peer else None)
    asked = "" if goal is None else f"{goal:g}" if result.ratio >= goal else f"{goal:g}, {MISSED}"
    value = f"{result.value:,.0f}" if result.value >= 1000 else f"{result.value:.3g}"
    ratio = f"{result.ratio:.2f}"
    if result.quickest is not None:
        ratio += f" (quickest tenth {result.quickest:.2f}, median {result.median:.2f})"
    where = result.conditions or machine()
    cells = (f"`{result.name}`", f"{value} {result.unit}", ratio, result.peer, asked, str(result.n), str(result.seed))
    return f"| {' | '.join((*cells, where, str(dt.date.today())))} |"


if __name__ == "__main__":
    sys.exit(main())
