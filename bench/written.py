"""Table 3 over six brushes: 字 子 永 written ten times by each, after practice and rounds of learning; loopback rig.

The brushes are the paper's and those of `bench.brushfit_brushes`, frozen before any score was looked at. The command is
the one that an operator would use, on a rig in a process of its own; wherever it asks for a fresh sheet, one is put in
and it goes on. `bench characters` does the same without a rig, in a tenth of the time.
"""

from __future__ import annotations

import csv
import itertools
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.brushfit_brushes import FROZEN
from bench.harness import BenchError, Result, machine
from bench.processes import ROOT, Process, started
from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.compare.score import Polarity
from brushloop.calibrate.writing.report import TABLE
from brushloop.calibrate.writing.scores import ANOTHER, HEADLINE, REFERENCE, SIMULATED, Table3Row, read_written
from brushloop.drivers.sim.brush_file import PAPER

CHARACTERS, WRITINGS, ROUNDS = "字子永", 10, 3
BRUSHES = (PAPER, *map(str, range(len(FROZEN))))
RATE = 20.0
MOST_SHEETS = 40
ASKED = re.compile(r"--sheet\s+(\d+)")
STRICT = HEADLINE
WHITE = (Alignment.MM, Tone.BINARY, Polarity.PAPER)
AS_THE_PAPER = (Alignment.SIZE_NORMALISED, Tone.BINARY, Polarity.PAPER)
"""The polarity in which the paper's numbers are within reach; the paper does not state its own."""


def run(*, n: int | None = None, seed: int = 1) -> Sequence[Result]:
    """CSIM of each captured character against the reference and the simulated image, for the first `n` brushes.

    value = average in percent over ten writings (mm, binary, ink = 1), all six brushes by default, some 15 minutes
    each; ratio = 100 less the CSIM of the unlearned round, over 100 less that of the learned one. `seed` is the rig's.
    Raises BenchError where a command fails or asks for something else than a sheet.
    """
    brushes = len(BRUSHES) if n is None else n
    if not 1 <= brushes <= len(BRUSHES):
        raise ValueError(f"n = {brushes}: 1 to {len(BRUSHES)} brushes")
    results: list[Result] = []
    for brush in BRUSHES[:brushes]:
        with tempfile.TemporaryDirectory() as scratch:
            out = write_characters(Path(scratch), brush, seed)
            places = [out / f"round-{number}" for number in range(1, ROUNDS + 1)]
            rounds = [list(read_written(place).table_3) for place in places if place.exists()]
            after, each = list(read_written(out).table_3), csim_of_writings(out / TABLE)
        name = brush if brush == PAPER else f"frozen {int(brush) + 1}"
        for character, pair in itertools.product(CHARACTERS, (REFERENCE, SIMULATED)):
            results.append(_result(name, character, pair, rounds, after, each[character], seed))
    return results


def csim_of_writings(path: Path) -> dict[str, list[float]]:
    """Character -> CSIM of each writing against the reference in percent (mm, binary, ink = 1), as written."""
    out: dict[str, list[float]] = {}
    with path.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            if (row["pair"], row["alignment"], row["tone"], row["polarity"]) == (REFERENCE, *map(str, STRICT)):
                out.setdefault(row["character"], []).append(100.0 * float(row["csim"]))
    return out


def write_characters(folder: Path, brush: str, seed: int) -> Path:
    """Run `brushloop write` to its end under `folder`; returns the folder of its report."""
    rig, out = folder / "rig.toml", folder / "written"
    words = ["write", CHARACTERS, "--config", str(rig), "--out", str(out), "--sessions", str(folder / "sessions")]
    words += ["--no-tui", "--count", str(WRITINGS), "--practice", "--learn", str(ROUNDS)]
    with started("bench.loop_rig", str(rig), brush, str(RATE), str(seed)) as process:
        _to_its_end(words, process)
    return out


def _to_its_end(words: list[str], rig: Process) -> None:
    sheet: list[str] = []
    errors = ""
    for _ in range(MOST_SHEETS):
        command = [sys.executable, "-m", "brushloop", *words, *sheet]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if ran.returncode == 0:
            return
        errors = ran.stderr.strip()[-400:]
        asked = ASKED.search(ran.stderr)
        if asked is None:
            raise BenchError(f"`brushloop write` ended with {ran.returncode}: {errors}")
        rig.ask()
        sheet = ["--sheet", asked[1]]
    raise BenchError(f"`brushloop write` has asked for {MOST_SHEETS} sheets: {errors}")


def _result(
    name: str,
    character: str,
    pair: str,
    rounds: list[list[Table3Row]],
    after: list[Table3Row],
    each: list[float],
    seed: int,
) -> Result:
    ours, before = _row(after, character, pair), [_row(rows, character, pair).csim[2] for rows in rounds]
    white, paper = _row(after, character, pair, WHITE), _row(after, character, pair, AS_THE_PAPER)
    another = _row(after, character, ANOTHER)
    low, value = ours.csim[1], ours.csim[2]
    ratio = (100.0 - before[0]) / (100.0 - value) if value < 100.0 else float("inf")
    conditions = (
        f"{ours.source}, brush {name}, {character}, {ours.n} writings; rounds "
        f"{' '.join(f'{csim:.1f}' for csim in before)}; CSIM {ours.csim[0]:.1f} / {low:.1f} / {value:.1f}, SSIM "
        f"{ours.ssim[0]:.1f} / {ours.ssim[1]:.1f} / {ours.ssim[2]:.1f} (max / min / avg, mm, ink = 1); paper = 1: "
        f"{white.csim[2]:.2f} and {white.ssim[2]:.2f}; first writing {each[0]:.1f}, last {each[-1]:.1f}; "
        f"size-normalised, paper = 1: {paper.csim[2]:.1f} and {paper.ssim[2]:.1f}, the paper's {paper.paper_row}: "
        f"{_paper(paper)}; another writing {another.csim[2]:.1f} and {another.ssim[2]:.1f}; reference: "
        f"{ours.reference}; {machine()}"
    )
    title = f"written: {name}, {character}, {pair}"
    return Result(title, value, "% CSIM", "the unlearned round's shortfall", ratio, ours.n, seed, conditions)


def _row(rows: list[Table3Row], character: str, pair: str, key: tuple[Alignment, Tone, Polarity] = STRICT) -> Table3Row:
    for row in rows:
        if (row.character, row.pair, row.alignment, row.tone, row.polarity) == (character, pair, *key):
            return row
    raise BenchError(f"the report has no row “{pair}” of {character}")


def _paper(row: Table3Row) -> str:
    if row.paper_csim is None or row.paper_ssim is None:
        return "not given"
    return f"{row.paper_csim[2]:.1f} and {row.paper_ssim[2]:.1f}"
