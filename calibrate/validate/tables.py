"""Queries on a report and its scores: Tables 1 to 3, CSV and Parquet, tables for the terminal, and gates.

A gate is a limit that a score must meet, as `csim_avg>=0.90` or `ccd-bsm-heldout:mm:binary:csim_avg>=0.93`.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import math
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from rich.table import Column, Table

from brushloop.calibrate.compare.paper import TABLE_1, TABLE_2, Printed
from brushloop.calibrate.compare.place import Alignment, Key, Tone
from brushloop.calibrate.compare.score import Polarity
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import replacing, write_whole
from brushloop.calibrate.loop.compare import AGAIN
from brushloop.calibrate.scores import MEASURES, Score, Scores
from brushloop.calibrate.stats import CEILING, Summary
from brushloop.calibrate.validate.models import (
    ANOTHER,
    FITTED_HELD_OUT,
    GENERATOR_HELD_OUT,
    HELD_OUT,
    LAMBDAS,
    REPEATED,
)
from brushloop.calibrate.validate.report import NORMAL, STRICT, Report
from brushloop.calibrate.writing.scores import ANOTHER as ANOTHER_WRITING
from brushloop.calibrate.writing.scores import PAPER_ROWS, PLANNED, REFERENCE, SIMULATED, Table3Row
from brushloop.sessions.disk import csv_text, number
from brushloop.sessions.terminal import narrow

MISSING = {
    "ccd-bsmg": "not in this run: give a trained one with --generator",
    REPEATED: "not in this run: “brushloop loop SESSION --config RIG” presses recovered strokes again; then validate "
    "again",
}
WRITTEN_ROWS = {
    SIMULATED: ("simulated", "each writing against the model's image of its plan"),
    REFERENCE: ("robot writing", "each writing against the reference"),
    ANOTHER_WRITING: ("another writing", "each writing against the others: how repeatable arm and brush are"),
    PLANNED: ("the plan", "simulated image against the reference: the best that the plan could give"),
}
"""Label and description of the row of Table 3 for each comparison."""
SHORT = {HELD_OUT: ", held out", "fitted, in sample": ", in sample"}
"""What a model knows of the strokes, shortened for the terminal."""
NUMBERS = ("depth_mm", "reached_mm", "tilt_deg", *MEASURES)
SUMMARY_COLUMNS = (
    *("model", "alignment", "tone", "measure", "depth_mm", "tilt_deg", "n", "max", "min"),
    *("avg", "avg_low", "avg_high", "median", "median_low", "median_high", "below_ceiling", "source"),
)
OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}
GATE = re.compile(
    r"((?P<model>[^:<>=]+):)??((?P<alignment>mm|size-normalised):)?((?P<tone>binary|gray):)?"
    r"(?P<measure>csim|ssim)_(?P<statistic>avg|median|min|max)\s*(?P<op>>=|<=|>|<)\s*(?P<limit>\S+)"
)
GATE_RULE = "expected [MODEL:][ALIGNMENT:][TONE:]csim_avg>=0.90, with csim or ssim, avg, median, min or max, and 0 to 1"


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row in the paper's layout; the scores are None if only the paper has such a row."""

    label: str
    basis: str
    csim: Summary | None
    ssim: Summary | None
    paper: Printed | None = None
    soft: bool = False
    """Whether it is what a model may be compared with, not a model: the ceiling, another writing, the plan."""

    @property
    def n(self) -> int:
        """Number of presses."""
        return 0 if self.csim is None else self.csim.n

    @property
    def ours(self) -> tuple[float | None, ...] | None:
        """CSIM max, min, avg, then SSIM."""
        if self.csim is None or self.ssim is None:
            return None
        return tuple(value for of in (self.csim, self.ssim) for value in (of.max, of.min, of.avg))


def table_1(report: Report, key: Key = NORMAL) -> list[TableRow]:
    """Rows of the generated models and robot writing, with calibrated models and the ceiling."""
    calibrated = [name for name in (FITTED_HELD_OUT, GENERATOR_HELD_OUT) if report.model(name) is not None]
    rows: list[TableRow] = []
    for name in (*TABLE_1, *calibrated, ANOTHER, CEILING):
        again = robot_writing(report, key) if name == REPEATED else []
        rows += again or [_row(report, name, TABLE_1.get(name), key)]
    return rows


def robot_writing(report: Report, key: Key = NORMAL) -> list[TableRow]:
    """Rows of strokes pressed again: scored in this run if it has both sessions, else taken from each loop."""
    scored = report.stat(REPEATED, key) is not None
    rows = [_row(report, REPEATED, TABLE_1[REPEATED], key)] if scored else []
    here = {session.recording_sha256 for session in report.sessions}
    for loop in report.loops:
        stat = loop.stat(AGAIN, key)
        if stat is not None and not (scored and loop.again_sha256 in here):
            basis = f"{loop.original} pressed again as {loop.again}, recovered by {loop.model}"
            if loop.mm_per_px != report.mm_per_px and key[0] is Alignment.MM:
                basis += f"; at {loop.mm_per_px:g} mm per pixel"
            rows.append(TableRow(TABLE_1[REPEATED].label, basis, stat.csim, stat.ssim, TABLE_1[REPEATED]))
    return rows


def table_2(report: Report, key: Key) -> list[TableRow]:
    """Rows of the paper's models in its order, then of all others; the paper's numbers stand beside `NORMAL` only."""
    last = (ANOTHER, CEILING)
    others = [model.name for model in report.models if model.name not in (*TABLE_2, *last, REPEATED, *LAMBDAS)]
    rows = [_row(report, name, TABLE_2.get(name), key) for name in (*TABLE_2, *others, *last)]
    return rows if key == NORMAL else [replace(row, paper=None) for row in rows if row.ours is not None]


def _row(report: Report, name: str, paper: Printed | None, key: Key) -> TableRow:
    stat, known = report.stat(name, key), report.model(name)
    label = known.label if known is not None else paper.label if paper is not None else name
    if stat is None or known is None:
        return TableRow(label, MISSING.get(name, "not in this run"), None, None, paper, name == CEILING)
    return TableRow(label, known.basis, stat.csim, stat.ssim, paper, name == CEILING)


class CharacterTable(NamedTuple):
    """One character of Table 3 in one alignment."""

    character: str
    title: str
    """Character, session, brush and cell."""
    alignment: Alignment
    rows: list[TableRow]
    """Binary; in both polarities, with the paper's rows, or in millimetres with ink = 1."""


def table_3(report: Report) -> Iterator[CharacterTable]:
    """Yield the tables of every character in every session of characters."""
    like = [(Polarity.INK, pair) for pair in WRITTEN_ROWS]
    like += [(Polarity.PAPER, pair) for pair in (SIMULATED, REFERENCE)]
    strict = [(Polarity.INK, pair) for pair in WRITTEN_ROWS]
    for name, record in [(name, one) for one in report.written for name in one.characters]:
        brush = record.brush or "an unnamed brush"
        title = f"{name}, written in {record.session} with {brush} on paper cells of {record.cell_mm:g} mm"
        rows = {(row.character, row.tone, row.alignment, row.polarity, row.pair): row for row in record.table_3}
        for alignment, keys in ((Alignment.SIZE_NORMALISED, like), (Alignment.MM, strict)):
            chosen = [rows.get((name, Tone.BINARY, alignment, *key)) for key in keys]
            yield CharacterTable(
                name, title, alignment, [_written_row(row, record.model) for row in chosen if row is not None]
            )


def _written_row(row: Table3Row, model: str) -> TableRow:
    label, basis = WRITTEN_ROWS[row.pair]
    basis += {SIMULATED: f", {model}", REFERENCE: f", {row.reference}"}.get(row.pair, "")
    paper = PAPER_ROWS.get(row.pair) if row.alignment is Alignment.SIZE_NORMALISED else None
    if paper is not None:
        basis += f" (beside the paper's {paper.label})"
    soft = row.pair in (ANOTHER_WRITING, PLANNED)
    return TableRow(f"{label}, {row.polarity}", basis, row.csim, row.ssim, paper, soft)


def pair(report: Report, name: str, key: Key) -> str:
    """Average `CSIM / SSIM`; empty if there is none."""
    stat = report.stat(name, key)
    return "" if stat is None else f"{stat.csim.avg:.2f} / {stat.ssim.avg:.2f}"


def write_csv(scores: Scores, path: Path) -> str:
    """Write every score and return the file's SHA-256. Raises OSError and leaves no partial file."""
    rows = ((*score[:-3], f"{score.csim:.8f}", f"{score.ssim:.8f}", score.source) for score in scores)
    text = csv_text(Score._fields, rows)
    write_whole(path, text)
    return hashlib.sha256(text.encode()).hexdigest()


def write_parquet(scores: Scores, label: str, path: Path) -> None:
    """Write the same rows as Parquet. Raises `CalibrationError` if pyarrow is not installed."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise CalibrationError("--parquet", "needs pyarrow: pip install 'brushloop[parquet]'") from None
    kinds = [(name, pa.float64() if name in NUMBERS else pa.string()) for name in Score._fields]
    rows = [score._asdict() for score in scores]
    with replacing(path) as part:
        pq.write_table(pa.Table.from_pylist(rows, schema=pa.schema(kinds, metadata={"source": label})), part)


def summary_csv(report: Report) -> str:
    """Return every statistic, per cell and overall; “robot writing” is what `brushloop loop` pressed again."""
    stats = [(stat.model, report.label, stat) for stat in report.stats]
    for loop in report.loops:
        again = (stat for stat in loop.table_1 if stat.model == AGAIN)
        stats += [(f"{REPEATED} ({loop.again})", str(loop.source), stat) for stat in again]
    rows: list[tuple[object, ...]] = []
    for (model, source, stat), measure in itertools.product(stats, MEASURES):
        of: Summary = getattr(stat, measure)
        avg, median = (ends or (None, None) for ends in (of.avg_interval, of.median_interval))
        place = model, stat.alignment, stat.tone, measure, *(stat.cell or (None, None))
        rows.append((*place, of.n, of.max, of.min, of.avg, *avg, of.median, *median, of.below_ceiling, source))
    return csv_text(SUMMARY_COLUMNS, rows)


def table_3_csv(report: Report) -> str:
    """Return every row of Table 3, with the paper's numbers in the corresponding rows."""
    head = ["session_id", "character", "reference", "model", "compared", "alignment", "tone", "polarity", "n"]
    head += [f"{of}_{what}" for of in MEASURES for what in ("max", "min", "avg", "median")]
    head += ["paper_row", *(f"paper_{of}_{what}" for of in MEASURES for what in ("max", "min", "avg")), "source"]
    rows: list[tuple[object, ...]] = []
    for record, row in [(written, row) for written in report.written for row in written.table_3]:
        about = record.session, row.character, row.reference, record.model, row.pair
        ours = (*row.csim.range_and_avg, row.csim.median, *row.ssim.range_and_avg, row.ssim.median)
        paper = PAPER_ROWS.get(row.pair)
        theirs = [""] * 7 if paper is None else [paper.label, *paper.csim, *paper.ssim]
        rows.append((*about, row.alignment, row.tone, row.polarity, row.csim.n, *ours, *theirs, record.source))
    return csv_text(head, rows)


def terminal_tables(report: Report) -> Iterator[Table]:
    """Yield the tables for the terminal."""
    for key in (NORMAL, STRICT):
        rows = [row for row in (*table_2(report, key), *robot_writing(report, key)) if row.ours is not None]
        yield _terminal_table(f"{key[0]}, binary, ink = 1, percent ({report.label})", key[0], rows)
    for table in table_3(report):
        title = f"Table 3: {table.character}, {table.alignment}, binary, percent ({report.label})"
        yield _terminal_table(title, table.alignment, table.rows)


def _terminal_table(title: str, alignment: Alignment, rows: Sequence[TableRow]) -> Table:
    """A narrow terminal has room for averages only."""
    # The paper's numbers stand only beside those that are made in the same way, as far as the paper describes it.
    with_paper = alignment is Alignment.SIZE_NORMALISED
    heads = ["CSIM\navg", "SSIM\navg"] if narrow() else ["CSIM\nmax", "min", "avg", "SSIM\nmax", "min", "avg"]
    first = Column("model", min_width=len("simulated"))
    table = Table(first, "n", *heads, *(["paper's avg"] if with_paper else []), title=title)
    for row in rows:
        ours = row.ours or ()
        words = ["" if score is None else f"{score:.2f}" for score in (ours[2::3] if narrow() else ours)]
        if with_paper:
            words.append(f"{row.paper.csim[2]:.2f} / {row.paper.ssim[2]:.2f}" if row.paper is not None else "")
        table.add_row(row.label + SHORT.get(row.basis, ""), str(row.n), *words)
    return table


class GateMissed(Exception):
    """A score misses its gate; the report is still written."""

    exit_code: ClassVar[int] = 5


@dataclass(frozen=True, slots=True)
class Gate:
    """One condition; without a model it applies to the report's calibrated model, or else to the first."""

    text: str
    model: str
    key: Key
    measure: str
    statistic: str
    op: str
    limit: float


def parse_gate(text: str) -> Gate:
    """Parse a gate. Raises `CalibrationError`."""
    parts = GATE.fullmatch(text.strip())
    try:
        limit = number("" if parts is None else parts["limit"])
    except ValueError:
        limit = math.nan
    if parts is None or not 0.0 <= limit <= 1.0:
        raise CalibrationError(f"--gate {text}", GATE_RULE)
    key = Alignment(parts["alignment"] or NORMAL[0]), Tone(parts["tone"] or NORMAL[1])
    return Gate(text.strip(), parts["model"] or "", key, parts["measure"], parts["statistic"], parts["op"], limit)


def check_gates(report: Report, gates: Sequence[Gate]) -> None:
    """Check the gates. Raises `GateMissed` naming all missed ones, `CalibrationError` for a model without scores."""
    missed: list[str] = []
    for gate in gates:
        model = gate.model or report.shown
        stat = report.stat(model, gate.key)
        if stat is None:
            known = ", ".join(dict.fromkeys(stat.model for stat in report.stats))
            raise CalibrationError(f"--gate {gate.text}", f"{model!r} has no score; scored: {known}")
        percent: float | None = getattr(getattr(stat, gate.measure), gate.statistic)
        if percent is None:
            raise CalibrationError(f"--gate {gate.text}", f"the {model} is an average and has no {gate.statistic}")
        if not OPERATORS[gate.op](0.01 * percent, gate.limit):
            which = f"{gate.measure}_{gate.statistic} of {', '.join((model, *gate.key))}"
            missed.append(f"{gate.text}: {which} is {0.01 * percent:.4f} ({report.label})")
    if missed:
        raise GateMissed(f"gate missed: {'; '.join(missed)}")
