"""What a person waits for: `bench startup`, until a command's work begins, and `bench analysis`, until its result.

Each figure is that of a whole command in a process of its own. Ink and photographs are those of the loopback rig.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.brushes import DEPTHS_MM, DESIGN, TILTS_DEG, collect_grid, press_session, simulated_rig
from bench.harness import BRUSHLOOP, Result, Used, at_most, interleave, machine, measure, rounds_of
from brushloop.drivers.sim.brush.brush import BrushSpec

START_GOAL_S = 0.7
STARTS = {
    "collect": "collect --config no.toml --protocol no.toml --no-tui",
    "collect plan": "collect plan --config no.toml --protocol no.toml",
    "doctor": "doctor --config no.toml",
    "calibrate": "calibrate nowhere",
    "fit": "fit nowhere",
    "validate": "validate nowhere",
    "recover": "recover nowhere",
    "repress": "repress nowhere --config no.toml",
    "write": "write 字 --config no.toml",
    "sessions export": "sessions export nowhere out",
    "sessions import": "sessions import nowhere --csv no.csv",
    "sim": "sim --write-rig no/rig.toml",
}
"""Each is timed until it refuses a file that is not there: everything that comes before its work."""
FIT_CPU_S, VALIDATE_S, AGAIN_S, REPORT_S, PEAK_MB = 4.0, 4.0, 3.0, 15.0, 600.0
FRESH_S, DEMO_S = 75.0, 30.0
"""The goals, on two quiet cores."""
COLLECTED = 150
RATE = 60.0


def startup(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Wall seconds of `python -m brushloop --help` beside `python -c "import typer"`, and CPU seconds of each command.

    ratio = the peer's time over ours, at most about 1 for `--help`: the front door imports typer as well. `n` rounds,
    10 by default, a third of them for the commands. Nothing is drawn, so the seed changes nothing.
    """
    rounds = rounds_of(n, 10)
    ours, peer = (*BRUSHLOOP, "--help"), (sys.executable, "-c", "import typer")
    turns = interleave(lambda: measure(*ours), lambda: measure(*peer), rounds)
    ours_s, peer_s = turns.median_s
    return [
        Result("startup", ours_s, "s", "import typer", peer_s / ours_s, rounds, seed, machine(), *turns.ratios()),
        *_starts(max(1, rounds // 3), seed),
    ]


def _starts(rounds: int, seed: int) -> Iterator[Result]:
    where = f"until a file that is not there is refused; {machine()}"
    with tempfile.TemporaryDirectory() as folder:
        for name, words in STARTS.items():
            command = (*BRUSHLOOP, *words.split())
            measure(*command, code=2, cwd=Path(folder))  # unmeasured: compiles what it imports, as after the first use
            cpu_s = statistics.median(measure(*command, code=2, cwd=Path(folder)).cpu_s for _ in range(rounds))
            yield at_most(f"startup.{name}", cpu_s, "CPU-s", START_GOAL_S, rounds, seed, where)


def analysis(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """CPU seconds of `fit`, wall seconds and memory of `validate`, and the same again, for 30 imported presses.

    The median of `n` runs of each command, 3 by default.
    """
    rounds = rounds_of(n, 3)
    with tempfile.TemporaryDirectory() as folder:
        place = press_session(Path(folder) / "presses", BrushSpec(seed=1 + seed), 2 * DESIGN, seed)
        fits = [measure(*BRUSHLOOP, "fit", place) for _ in range(rounds)]
        first = [measure(*BRUSHLOOP, "validate", place, "--out", f"{folder}/{k}") for k in range(rounds)]
        again = [measure(*BRUSHLOOP, "validate", place, "--out", f"{folder}/{k}") for k in range(rounds)]
    busy_s = statistics.median(used.cpu_s for used in first)
    where = f"loopback rig, {2 * len(DESIGN)} presses; validate used {busy_s:.1f} CPU-s; {machine()}"
    figures = (
        ("fit", [used.cpu_s for used in fits], "CPU-s", FIT_CPU_S),
        ("validate", [used.wall_s for used in first], "s", VALIDATE_S),
        ("validate again", [used.wall_s for used in again], "s", AGAIN_S),
        ("memory", [used.peak_mb for used in first], "MB", PEAK_MB),
    )
    return [
        at_most(f"analysis.{name}", statistics.median(values), unit, goal, rounds, seed, where)
        for name, values, unit, goal in figures
    ]


def report(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Wall seconds of `analyse`, from the photographs of about `n` collected presses (150) to the report.

    The presses are collected first, on the loopback rig at 60 times its speed, which takes minutes and does not count.
    """
    strokes = rounds_of(n, COLLECTED)
    with tempfile.TemporaryDirectory() as folder:
        repeats = max(1, round(strokes / len(DESIGN)))
        with simulated_rig(Path(folder), "table2", RATE, seed + 1) as rig:
            session = collect_grid(Path(folder), rig, DEPTHS_MM, TILTS_DEG, repeats, seed)
        used = measure(*BRUSHLOOP, "analyse", session)
    where = f"loopback rig, {strokes} presses; {machine()}"
    name = "report.150 presses" if strokes == COLLECTED else "report"
    return [
        at_most(name, used.wall_s, "s", REPORT_S, strokes, seed, where),
        at_most("report.memory", used.peak_mb, "MB", PEAK_MB, strokes, seed, where),
    ]


def demo(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Wall seconds of `brushloop demo` in a new folder: with nothing compiled, and again in another folder.

    Once each; `n` changes nothing.
    """
    with tempfile.TemporaryDirectory() as folder:
        caches = {"PYTHONPYCACHEPREFIX": f"{folder}/bytecode", "NUMBA_CACHE_DIR": f"{folder}/numba"}
        caches["PYTHONDONTWRITEBYTECODE"] = ""
        used: list[Used] = []
        for name in ("first", "second"):
            place = Path(folder) / name
            place.mkdir()
            used.append(measure(*BRUSHLOOP, "demo", cwd=place, environment=caches))
    fresh, later = used
    return [
        at_most("demo.fresh", fresh.wall_s, "s", FRESH_S, 1, seed),
        at_most("demo.again", later.wall_s, "s", DEMO_S, 1, seed),
    ]
