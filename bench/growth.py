"""Time and peak memory of commands by number of strokes, with stills of the size and noise of the rig's camera.

Each command is a process of its own, started by a small one, so that its peak is its own. A few dozen stills are drawn;
the others are links to them. A brush is fitted to these few, and `validate` compares it with all.

`python -m bench.growth 20000` measures up to 20,000 strokes, renews the rows in docs/bench.md and draws
docs/growth.svg; `python -m bench growth --largest 5000` only measures. With `--small`, pictures are of 480 x 300 px
without noise: for the number of strokes alone, in a twentieth of the time and of the disk.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench import table
from bench.harness import BenchError, Result, machine
from bench.peak import Used, measure
from bench.press_sessions import CLOSE, STILL, Presses, View, photographs, session, write_table
from calibrate.artefact import current
from calibrate.fit.artefact import FOLDER as FITS

SIZES = (100, 300, 1000, 5000, 20_000)
LARGEST = 300
"""By default, so that all benches together take minutes."""
LEVEL_FROM = 1000
"""Memory is compared with what this many strokes take, where more are measured."""
MOST_GROWTH = 1.05
PICTURE = Path(__file__).resolve().parent.parent / "docs" / "growth.svg"
EXPORTS = ("png", "npz", "parquet")
COMMANDS = ("import", "verify", "merge", *(f"export-{kind}" for kind in EXPORTS), "validate")


@dataclass(frozen=True, slots=True)
class Point:
    """What one command took for this many strokes."""

    command: str
    strokes: int
    used: Used


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Every command at the `SIZES` up to `n` strokes (default `LARGEST`).

    `-time` is the CPU time of each further stroke at the largest sizes; ratio = the same at the smallest sizes over it.
    `-memory` is the peak at the largest size; ratio = 1.05 times the peak at 1,000 strokes over it.
    """
    return results(list(measured(LARGEST if n is None else n, seed)), seed)


def measured(largest: int, seed: int, view: View = STILL) -> Iterator[Point]:
    """Every command at each size, with at most one session of the largest size and a copy of it on the disk."""
    if largest < SIZES[0] + 1:
        raise ValueError(f"n = {largest}: more than {SIZES[0]} strokes are needed")
    presses = Presses(largest, seed, view=view)
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        photos = photographs(under / "photos", presses)
        another = session(under, "another", replace(presses, strokes=presses.distinct))
        brushloop = (sys.executable, "-m", "brushloop")
        measure(*brushloop, "fit", str(another))
        fitted = current(another, FITS)
        if fitted is None:
            raise BenchError("the brush was not fitted")
        for strokes in (*(size for size in SIZES if size < largest), largest):
            write_table(photos, replace(presses, strokes=strokes))
            place, out = under / f"of-{strokes}", under / "out"
            commands: dict[str, tuple[str | Path, ...]] = {
                "import": (
                    "sessions",
                    "import",
                    photos,
                    "--csv",
                    photos / "strokes.csv",
                    "--kind",
                    "press",
                    "--out",
                    place,
                ),
                "verify": ("sessions", "verify", place),
                "merge": ("sessions", "merge", out / "merged.mcap", place, another),
                **{f"export-{kind}": ("sessions", "export", place, out / kind, "--format", kind) for kind in EXPORTS},
                "validate": ("validate", place, "--fit", fitted, "--out", out / "report"),
            }
            for name, words in commands.items():
                out.mkdir()
                yield Point(name, strokes, measure(*brushloop, *map(str, words)))
                shutil.rmtree(out)
            shutil.rmtree(place)


def results(points: Sequence[Point], seed: int, view: View = STILL) -> list[Result]:
    """Two figures of each command."""
    made: list[Result] = []
    name = "growth" if view is STILL else "growth-small"
    size = f"stills of {view.width_px} x {view.height_px} px{' with noise' if view.noise else ''}"
    for command, mine in by_command(points).items():
        (a, b), (y, z) = mine[:2], mine[-2:]
        level = next((point for point in mine[:-1] if point.strokes == LEVEL_FROM), mine[0])
        each = "; ".join(
            f"{point.strokes:,} strokes: {point.used.wall_s:.1f} s, {point.used.cpu_s:.1f} CPU-s, "
            f"{point.used.peak_mb:.0f} MB"
            for point in mine
        )
        where = f"loopback rig, {size}; {command}: {each}; {machine()}"
        first_ms, last_ms = each_ms(a, b), each_ms(y, z)
        peak_mb, level_mb = z.used.peak_mb, level.used.peak_mb
        made += [
            Result(
                f"{name}-{command}-time",
                last_ms,
                f"CPU-ms a stroke from {y.strokes:,} to {z.strokes:,}",
                f"from {a.strokes:,} to {b.strokes:,} strokes",
                first_ms / last_ms,
                1,
                seed,
                where,
            ),
            Result(
                f"{name}-{command}-memory",
                peak_mb,
                f"MB at {z.strokes:,} strokes",
                f"{MOST_GROWTH:g} times the peak at {level.strokes:,}",
                MOST_GROWTH * level_mb / peak_mb,
                1,
                seed,
                where,
            ),
        ]
    return made


def by_command(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Points of each command, from few strokes to many."""
    ordered = sorted(points, key=lambda point: (COMMANDS.index(point.command), point.strokes))
    return {name: list(mine) for name, mine in itertools.groupby(ordered, key=lambda point: point.command)}


def each_ms(few: Point, many: Point) -> float:
    """CPU milliseconds of each stroke that `many` has more than `few`."""
    return 1e3 * (many.used.cpu_s - few.used.cpu_s) / (many.strokes - few.strokes)


def draw(points: Sequence[Point], path: Path, title: str) -> None:
    """CPU time and peak memory by number of strokes, which is on a logarithmic axis."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(10.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    for command, mine in by_command(points).items():
        strokes = [point.strokes for point in mine]
        left.loglog(strokes, [point.used.cpu_s for point in mine], marker=".", label=command)
        right.semilogx(strokes, [point.used.peak_mb for point in mine], marker=".", label=command)
    left.set(xlabel="strokes", ylabel="CPU time, s")
    right.set(xlabel="strokes", ylabel="peak memory, MB", ylim=(0, None))
    for axis in (left, right):
        axis.grid(alpha=0.3)
    right.legend(fontsize=8)
    figure.suptitle(title, fontsize=9)
    with mpl.rc_context({"svg.hashsalt": "growth", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Measure, draw the picture, renew the table and print the figures."""
    parser = argparse.ArgumentParser(prog="python -m bench.growth", description="Time and memory by number of strokes.")
    parser.add_argument("largest", nargs="?", type=int, default=SIZES[-2])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="pictures of 480 x 300 px without noise")
    options = parser.parse_args()
    points: list[Point] = []
    view = CLOSE if options.small else STILL
    for point in measured(options.largest, options.seed, view):
        points.append(point)
        used = point.used
        words = f"{point.command}: {point.strokes:,} strokes, {used.wall_s:.1f} s, {used.cpu_s:.1f} CPU-s"
        sys.stdout.write(f"# {words}, {used.peak_mb:.0f} MB\n")
        sys.stdout.flush()
    command = f"python -m bench.growth {options.largest}{' --small' if options.small else ''} --seed {options.seed}"
    title = f"simulated presses, pictures of {view.width_px} x {view.height_px} px; {command}"
    draw(points, PICTURE.with_stem("growth-small") if options.small else PICTURE, title)
    found = results(points, options.seed, view)
    table.renew(found)
    sys.stdout.writelines(f"{result.to_line()}\n" for result in found)


if __name__ == "__main__":
    try:
        main()
    except BenchError as error:
        sys.exit(str(error))
