"""`python -m bench [NAME] [-n N] [--json] [--table]`: run one benchmark, or all, and print a line for each figure.

With --table, docs/bench.md gets the figures as well.

Exit codes: 0 measured, 1 a benchmark could not be measured, 2 unknown name.
"""

from __future__ import annotations

import argparse
import sys

from bench import (
    adaptive,
    analysis,
    brushfit,
    curves,
    generator,
    growth,
    inversion,
    loop,
    overhead,
    paper_brush,
    preprocess,
    quality,
    raster,
    realink,
    recorder,
    rpc,
    startup,
    structure,
    table,
    tables,
    tui,
    validate,
    written,
)
from bench.harness import Bench, BenchError, results_of


def benches() -> dict[str, Bench]:
    """Every benchmark by name; a new one is added here."""
    return {
        "adaptive": adaptive.run,
        "analysis": analysis.run,
        "brushfit": brushfit.run,
        "curves": curves.run,
        "generator": generator.run,
        "generator-qbc": generator.run_qbc,
        "growth": growth.run,
        "inversion": inversion.run,
        "loop": loop.run,
        "overhead": overhead.run,
        "paper-brush": paper_brush.run,
        "preprocess": preprocess.run,
        "quality": quality.run,
        "raster": raster.run,
        "realink": realink.run,
        "recorder": recorder.run,
        "rpc": rpc.run,
        "startup": startup.run,
        "structure": structure.run,
        "tables": tables.run,
        "tui": tui.run,
        "validate": validate.run,
        "written": written.run,
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    known = benches()
    parser = argparse.ArgumentParser(prog="python -m bench", description="Measure this project beside its peers.")
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"one of {', '.join(known)}; all when left out")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--table", action="store_true", help=f"renew the figures' rows in {table.OUT.name}")
    parser.add_argument("-n", "--largest", type=int, dest="n", help="rounds, or strokes, or the largest of `growth`")
    options = parser.parse_args(arguments)
    if options.name is not None and options.name not in known:
        print(f"unknown bench {options.name!r}; known: {', '.join(known)}", file=sys.stderr)
        return 2
    code = 0
    for name in known if options.name is None else [options.name]:
        try:
            results = results_of(known[name](n=options.n))
        except BenchError as error:
            print(f"{name}: {error}", file=sys.stderr)
            code = 1
            continue
        if options.table:
            table.renew(results)
        for before, result in zip([None, *results], results, strict=False):
            if not options.json and result.conditions and (before is None or before.conditions != result.conditions):
                print(f"# {result.conditions}")
            print(result.to_json() if options.json else result.to_line(), flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
