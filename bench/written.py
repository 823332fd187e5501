"""Table 3 over the frozen brushes: 字 written ten times by each after three rounds of learning; loopback rig.

The brushes are those of `bench.brushfit_brushes`, frozen before any score was looked at. The command is the one that an
operator would use, on a rig in a process of its own; wherever it asks for a fresh sheet, one is put in and it goes on.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.brushfit_brushes import FROZEN
from bench.harness import BenchError, Result, machine
from bench.processes import ROOT, Process, started
from calibrate.compare.field import Alignment, Tone
from calibrate.compare.similarity import Polarity
from calibrate.writing.scores import ANOTHER, REFERENCE, SIMULATED, Table3Row, read_written

CHARACTER, WRITINGS, ROUNDS = "字", 10, 3
RATE = 20.0
MOST_SHEETS = 20
ASKED = re.compile(r"--sheet\s+(\d+)")
STRICT = (Alignment.MM, Tone.BINARY, Polarity.INK)
AS_THE_PAPER = (Alignment.SIZE_NORMALISED, Tone.BINARY, Polarity.PAPER)
"""The polarity in which the paper's numbers are within reach; the paper does not state its own."""


def run(*, n: int | None = None, seed: int = 1) -> Sequence[Result]:
    """CSIM of the captured 字 against the reference and against the simulated image, for the first `n` frozen brushes.

    value = average in percent over ten writings (mm, binary, ink = 1), all five brushes by default, about 4 minutes
    each; ratio = 100 less the CSIM of the unlearned round, over 100 less that of the learned one. `seed` is the rig's.
    Raises BenchError where a command fails or asks for something else than a sheet.
    """
    brushes = len(FROZEN) if n is None else n
    if not 1 <= brushes <= len(FROZEN):
        raise ValueError(f"n = {brushes}: 1 to {len(FROZEN)} brushes")
    results: list[Result] = []
    for brush in range(brushes):
        with tempfile.TemporaryDirectory() as scratch:
            out = write_characters(Path(scratch), brush, seed)
            before, after = (list(read_written(place).table_3) for place in (out / "round-1", out))
        results += [_result(brush, pair, before, after, seed) for pair in (REFERENCE, SIMULATED)]
    return results


def write_characters(folder: Path, brush: int, seed: int) -> Path:
    """Run `brushloop write` to its end under `folder`; returns the folder of its report."""
    rig, out = folder / "rig.toml", folder / "written"
    words = ["write", CHARACTER, "--config", str(rig), "--out", str(out), "--sessions", str(folder / "sessions")]
    words += ["--no-tui", "--count", str(WRITINGS), "--learn", str(ROUNDS)]
    with started("bench.loop_rig", str(rig), str(brush), str(RATE), str(seed)) as process:
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


def _result(brush: int, pair: str, before: list[Table3Row], after: list[Table3Row], seed: int) -> Result:
    ours, unlearned = _row(after, pair), _row(before, pair)
    paper, another = _row(after, pair, AS_THE_PAPER), _row(after, ANOTHER)
    low, value = ours.csim[1], ours.csim[2]
    ratio = (100.0 - unlearned.csim[2]) / (100.0 - value) if value < 100.0 else float("inf")
    conditions = (
        f"{ours.source}, brush {brush + 1}, {CHARACTER}, {ours.n} writings after {ROUNDS} rounds of learning; CSIM "
        f"{ours.csim[0]:.1f} / {low:.1f} / {value:.1f}, SSIM {ours.ssim[0]:.1f} / {ours.ssim[1]:.1f} / "
        f"{ours.ssim[2]:.1f} (max / min / avg, mm, ink = 1); unlearned {unlearned.csim[2]:.1f} and "
        f"{unlearned.ssim[2]:.1f} (n = {unlearned.n}); size-normalised, paper = 1: {paper.csim[2]:.1f} and "
        f"{paper.ssim[2]:.1f}, the paper's {paper.paper_row}: {_paper(paper)}; another writing "
        f"{another.csim[2]:.1f} and {another.ssim[2]:.1f}; reference: {ours.reference}; {machine()}"
    )
    title = f"written: brush {brush + 1}, {pair}"
    return Result(title, value, "% CSIM", "the unlearned round's shortfall", ratio, ours.n, seed, conditions)


def _row(rows: list[Table3Row], pair: str, key: tuple[Alignment, Tone, Polarity] = STRICT) -> Table3Row:
    for row in rows:
        if (row.pair, row.alignment, row.tone, row.polarity) == (pair, *key):
            return row
    raise BenchError(f"the report has no row “{pair}”")


def _paper(row: Table3Row) -> str:
    if row.paper_csim is None or row.paper_ssim is None:
        return "not given"
    return f"{row.paper_csim[2]:.1f} and {row.paper_ssim[2]:.1f}"
