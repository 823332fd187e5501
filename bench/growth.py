"""Time and peak memory of commands by number of strokes, on small pictures and on stills of the rig's camera.

Each command is a process of its own, started by a small one, so that its peak is its own. A few dozen stills are drawn;
the others are links to them. A brush is fitted to these few, and `validate` compares it with all.

`python -m bench.growth` measures up to 5,000 strokes on pictures of 480 x 300 px without noise, and up to 1,000 on
stills of 2048 x 1536 px with noise, which take about twenty times the time and disk. It keeps every point in
docs/growth.csv, draws docs/growth.svg from them and renews the rows in docs/bench.md; `--small 0` or `--full 0` leaves
one kind out, whose points stay as they are. `python -m bench growth` only measures, on the full stills.
"""

from __future__ import annotations

import argparse
import csv
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
from bench.press_sessions import CLOSE, STILL, Presses, photographs, session, write_table
from brushloop.calibrate.artefact import current
from brushloop.calibrate.fit.artefact import FOLDER as FITS

SIZES = (100, 300, 1000, 5000, 20_000)
LARGEST = 300
"""By default, so that all benches together take minutes."""
LEVEL_FROM = 1000
"""Memory is compared with what this many strokes take, where more are measured."""
MOST_GROWTH = 1.05
DOCS = Path(__file__).resolve().parent.parent / "docs"
POINTS, PICTURE = DOCS / "growth.csv", DOCS / "growth.svg"
VIEWS = {"small": CLOSE, "full": STILL}
COLUMNS = ("view", "command", "strokes", "wall_s", "cpu_s", "peak_mb")
EXPORTS = ("png", "npz", "parquet")
COMMANDS = ("import", "verify", *(f"export-{kind}" for kind in EXPORTS), "validate")


@dataclass(frozen=True, slots=True)
class Point:
    """What one command took for this many strokes, on pictures of one of `VIEWS`."""

    command: str
    strokes: int
    used: Used
    view: str = "full"


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Every command at the `SIZES` up to `n` strokes (default `LARGEST`).

    `-time` is the CPU time of each further stroke at the largest sizes; ratio = the same at the smallest sizes over it.
    `-memory` is the peak at the largest size; ratio = 1.05 times the peak at 1,000 strokes over it.
    """
    return results(list(measured(LARGEST if n is None else n, seed)), seed)


def measured(largest: int, seed: int, view: str = "full") -> Iterator[Point]:
    """Every command at each size, with at most one session of the largest size and a copy of it on the disk."""
    if largest < SIZES[0] + 1:
        raise ValueError(f"n = {largest}: more than {SIZES[0]} strokes are needed")
    presses = Presses(largest, seed, view=VIEWS[view])
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
                **{f"export-{kind}": ("sessions", "export", place, out / kind, "--format", kind) for kind in EXPORTS},
                "validate": ("validate", place, "--fit", fitted, "--out", out / "report"),
            }
            for name, words in commands.items():
                out.mkdir()
                yield Point(name, strokes, measure(*brushloop, *map(str, words)), view)
                shutil.rmtree(out)
            shutil.rmtree(place)


def results(points: Sequence[Point], seed: int) -> list[Result]:
    """Two figures of each command; the points are of one view."""
    made: list[Result] = []
    name = "growth" if points[0].view == "full" else "growth-small"
    size = _size(points[0].view)
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


def kept(measured_now: Sequence[Point], path: Path = POINTS) -> list[Point]:
    """Renew the file with what was measured now; all points that it then holds."""
    points: dict[tuple[str, str, int], Point] = {}
    if path.exists():
        for row in csv.DictReader(path.read_text().splitlines()):
            used = Used(*(float(row[name]) for name in COLUMNS[3:]))
            points[row["view"], row["command"], int(row["strokes"])] = Point(
                row["command"], int(row["strokes"]), used, row["view"]
            )
    points |= {(point.view, point.command, point.strokes): point for point in measured_now}
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")  # noqa: TID251
        writer.writerow(COLUMNS)
        for (view, command, strokes), point in points.items():
            used = point.used
            writer.writerow((view, command, strokes, f"{used.wall_s:.1f}", f"{used.cpu_s:.2f}", f"{used.peak_mb:.1f}"))
    return list(points.values())


def draw(points: Sequence[Point], path: Path = PICTURE) -> None:
    """CPU time and peak memory by number of strokes, a row of plots for each view."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    views = [view for view in VIEWS if any(point.view == view for point in points)]
    figure: Any = Figure(figsize=(10.0, 4.0 * len(views)), layout="constrained")
    for view, (left, right) in zip(views, figure.subplots(len(views), 2, squeeze=False), strict=True):
        for command, mine in by_command([point for point in points if point.view == view]).items():
            strokes = [point.strokes for point in mine]
            left.loglog(strokes, [point.used.cpu_s for point in mine], marker=".", label=command)
            right.semilogx(strokes, [point.used.peak_mb for point in mine], marker=".", label=command)
        left.set(xlabel="strokes", ylabel="CPU time, s")
        right.set(xlabel="strokes", ylabel="peak memory, MB", ylim=(0, None))
        for axis in (left, right):
            axis.set_title(f"simulated presses, {_size(view)}", fontsize=9)
            axis.grid(alpha=0.3)
        right.legend(fontsize=7, ncols=2)
    with mpl.rc_context({"svg.hashsalt": "growth", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None})


def _size(view: str) -> str:
    size = VIEWS[view]
    return f"{view} pictures of {size.width_px} x {size.height_px} px{' with noise' if size.noise else ''}"


def main() -> None:
    """Measure, keep the points, draw the picture, renew the table and print the figures."""
    parser = argparse.ArgumentParser(prog="python -m bench.growth", description="Time and memory by number of strokes.")
    parser.add_argument(
        "--small", type=int, default=5000, metavar="STROKES", help="most, on small pictures; 0 for none"
    )
    parser.add_argument("--full", type=int, default=1000, metavar="STROKES", help="on full stills; 0 for none")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for view, largest in (("small", options.small), ("full", options.full)):
        points: list[Point] = []
        for point in measured(largest, options.seed, view) if largest else ():
            points.append(point)
            used = point.used
            words = f"{view}, {point.command}: {point.strokes:,} strokes, {used.wall_s:.1f} s, {used.cpu_s:.1f} CPU-s"
            sys.stdout.write(f"# {words}, {used.peak_mb:.0f} MB\n")
            sys.stdout.flush()
            draw(kept([point]))
        if points:
            found = results(points, options.seed)
            table.renew(found)
            sys.stdout.writelines(f"{result.to_line()}\n" for result in found)


if __name__ == "__main__":
    try:
        main()
    except BenchError as error:
        sys.exit(str(error))
