"""`python -m bench [NAME] [-n N] [--json] [--table]`: run one benchmark, or many, and print a line for each figure.

Without NAME, those of speed and memory (about 12 minutes), or with --accuracy those that train, fit and press (hours).
With --table, docs/bench.md gets the figures as well.

Exit codes: 0 measured, 1 a benchmark could not be measured, 2 unknown name.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping, Sequence

from bench import table, whole
from bench.harness import Bench, BenchError, Result, results_of


def benches() -> dict[str, Bench]:
    """Every benchmark by name; a new one is added here. What a benchmark needs is imported when it runs."""
    return {
        "analysis": _late("analysis"),
        "brushfit": _late("brushfit"),
        "inversion": _late("inversion"),
        "loop": _late("loop"),
        "overhead": _late("overhead"),
        "paper-brush": _late("paper_brush"),
        "quality": _late("quality"),
        "raster": _late("raster"),
        "realink": _late("realink"),
        "recorder": _late("recorder"),
        "startup": _late("startup"),
        "tui": _late("tui"),
        "twin": _late("twin"),
        "validate": _late("validate"),
        "written": _late("written"),
    }


def _late(module: str, function: str = "run") -> Bench:
    def run(*, n: int | None = None, seed: int = 0) -> Result | Sequence[Result]:
        bench: Bench = getattr(importlib.import_module(f"bench.{module}"), function)
        return bench(n=n) if seed == 0 else bench(n=n, seed=seed)  # some have a seed of their own by default

    return run


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    known = benches()
    parser = argparse.ArgumentParser(prog="python -m bench", description="Measure this project beside its peers.")
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"one of {', '.join(known)}")
    parser.add_argument("--accuracy", action="store_true", help=f"without NAME: {', '.join(whole.ACCURACY)}; hours")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--table", action="store_true", help=f"renew the figures' rows in {table.OUT.name}")
    parser.add_argument("-n", type=int, help="rounds, or strokes")
    options = parser.parse_args(arguments)
    if options.name is not None and options.name not in known:
        print(f"unknown bench {options.name!r}; known: {', '.join(known)}", file=sys.stderr)
        return 2
    if options.name is None:
        if options.n is not None:
            print("-n: goes with a NAME", file=sys.stderr)
            return 2
        return _several(whole.ACCURACY if options.accuracy else whole.SPEED, as_json=options.json, kept=options.table)
    try:
        results = results_of(known[options.name](n=options.n))
    except BenchError as error:
        print(f"{options.name}: {error}", file=sys.stderr)
        return 1
    if options.table:
        table.renew(results)
    for before, result in zip([None, *results], results, strict=False):
        if not options.json and result.conditions and (before is None or before.conditions != result.conditions):
            print(f"# {result.conditions}")
        print(result.to_json() if options.json else result.to_line(), flush=True)
    return 0


def _several(plan: Mapping[str, int], *, as_json: bool, kept: bool) -> int:
    """Run the benches of a plan; progress, and what was missed, go to stderr. Returns the exit code."""
    words = [word for word, wanted in (("--json", as_json), ("--table", kept)) if wanted]
    failed = whole.run_all(plan, words, lambda line: print(line, file=sys.stderr, flush=True))
    if kept:
        for line in table.missed():
            print(f"goal missed: {line}", file=sys.stderr)
    if failed:
        print(f"not measured: {', '.join(failed)}; their rows in {table.OUT.name} are as before", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
