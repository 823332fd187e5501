"""Queries on a report: the rows of Tables 1 to 3, summary.csv, tables for the terminal, and gates.

A gate is a score that must be reached, as `csim_avg>=0.90` or `ccd-bsm-heldout:mm:binary:csim_avg>=0.93`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from typing import ClassVar, NamedTuple

from rich.table import Table

from brushloop.calibrate.compare.place import ROBOT_WRITING, TABLE_1, TABLE_2, Alignment, Key, Polarity, Printed, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.loop import AGAIN
from brushloop.calibrate.scores import MEASURES, Stat
from brushloop.calibrate.stats import CEILING, Summary
from brushloop.calibrate.validate.models import ANOTHER, FITTED_HELD_OUT, GENERATOR_HELD_OUT, HELD_OUT, LAMBDAS
from brushloop.calibrate.validate.report import NORMAL, STRICT, Report
from brushloop.calibrate.writing.compare import ANOTHER as ANOTHER_WRITING
from brushloop.calibrate.writing.compare import PAPER_ROWS, PLANNED, REFERENCE, SIMULATED, Table3Row
from brushloop.sessions.disk import csv_text

MISSING = {
    "ccd-bsmg": "not in this run: give a trained one with --generator",
    ROBOT_WRITING: "not in this run: “brushloop loop SESSION --config RIG” presses recovered strokes again; then "
    "validate again",
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
SUMMARY_COLUMNS = (
    *("model", "alignment", "tone", "measure", "depth_mm", "tilt_deg", "n", "max", "min"),
    *("avg", "avg_low", "avg_high", "median", "median_low", "median_high", "below_ceiling", "source"),
)
GATE = re.compile(
    r"((?P<model>[^:<>=]+):)??((?P<alignment>mm|size-normalised):)?((?P<tone>binary|gray):)?"
    r"(?P<measure>csim|ssim)_(?P<statistic>avg|median|min|max)\s*>=\s*(?P<limit>0|1|[01]?\.\d+)"
)
GATE_RULE = "expected [MODEL:][ALIGNMENT:][TONE:]csim_avg>=0.90, with csim or ssim, avg, median, min or max, and 0 to 1"


class TableRow(NamedTuple):
    """One row in the paper's layout."""

    label: str
    basis: str
    scores: Stat | Table3Row | None
    """None if only the paper has such a row."""
    paper: Printed | None = None
    soft: bool = False
    """Whether it is what a model may be compared with, not a model: the ceiling, another writing, the plan."""

    @property
    def ours(self) -> tuple[float | None, ...]:
        """CSIM max, min, avg, then SSIM; empty without scores."""
        return () if self.scores is None else (*self.scores.csim.range_and_avg, *self.scores.ssim.range_and_avg)


def table_1(report: Report) -> list[TableRow]:
    """Rows of the generated models and robot writing, with calibrated models and the ceiling."""
    calibrated = [name for name in (FITTED_HELD_OUT, GENERATOR_HELD_OUT) if report.model(name) is not None]
    rows = [_row(report, name, TABLE_1[name]) for name in TABLE_1 if name != ROBOT_WRITING]
    rows += robot_writing(report) or [_row(report, ROBOT_WRITING, TABLE_1[ROBOT_WRITING])]
    return rows + [_row(report, name) for name in (*calibrated, ANOTHER, CEILING)]


def robot_writing(report: Report, key: Key = NORMAL) -> list[TableRow]:
    """Rows of strokes pressed again, one of each loop."""
    rows: list[TableRow] = []
    for loop in report.loops:
        basis = f"{loop.original} pressed again as {loop.again}, recovered by {loop.model}"
        if loop.mm_per_px != report.mm_per_px and key[0] is Alignment.MM:
            basis += f"; at {loop.mm_per_px:g} mm per pixel"
        rows.append(TableRow(ROBOT_WRITING, basis, loop.stat(AGAIN, key), TABLE_1[ROBOT_WRITING]))
    return rows


def table_2(report: Report, key: Key = NORMAL) -> list[TableRow]:
    """Rows of the paper's models in its order, then of all others."""
    last = (ANOTHER, CEILING)
    others = [model.name for model in report.models if model.name not in (*TABLE_2, *last, *LAMBDAS)]
    return [_row(report, name, TABLE_2.get(name), key) for name in (*TABLE_2, *others, *last)]


def _row(report: Report, name: str, paper: Printed | None = None, key: Key = NORMAL) -> TableRow:
    known = report.model(name)
    label = known.label if known is not None else paper.label if paper is not None else name
    basis = known.basis if known is not None else MISSING.get(name, "not in this run")
    return TableRow(label, basis, report.stat(name, key), paper, name == CEILING)


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
    strict = [(Polarity.INK, compared) for compared in WRITTEN_ROWS]
    like = [*strict, *((Polarity.PAPER, compared) for compared in PAPER_ROWS)]
    for record, name in ((written, name) for written in report.written for name in written.characters):
        brush = record.brush or "an unnamed brush"
        title = f"{name}, written in {record.session} with {brush} on paper cells of {record.cell_mm:g} mm"
        rows = {
            (row.tone, row.alignment, row.polarity, row.pair): row for row in record.table_3 if row.character == name
        }
        for alignment, keys in ((Alignment.SIZE_NORMALISED, like), (Alignment.MM, strict)):
            chosen = [row for key in keys if (row := rows.get((Tone.BINARY, alignment, *key))) is not None]
            yield CharacterTable(name, title, alignment, [_written_row(row, record.model) for row in chosen])


def _written_row(row: Table3Row, model: str) -> TableRow:
    label, basis = WRITTEN_ROWS[row.pair]
    basis += {SIMULATED: f", {model}", REFERENCE: f", {row.reference}"}.get(row.pair, "")
    paper = PAPER_ROWS.get(row.pair) if row.alignment is Alignment.SIZE_NORMALISED else None
    if paper is not None:
        basis += f" (beside the paper's {paper.label})"
    return TableRow(f"{label}, {row.polarity}", basis, row, paper, row.pair not in PAPER_ROWS)


def summary_csv(report: Report) -> str:
    """Return every statistic, per cell and overall; “robot writing” is what `brushloop loop` pressed again."""
    stats = [(stat.model, report.label, stat) for stat in report.stats]
    for loop in report.loops:
        again = (stat for stat in loop.table_1 if stat.model == AGAIN)
        stats += [(f"{ROBOT_WRITING} ({loop.again})", str(loop.source), stat) for stat in again]
    rows: list[tuple[object, ...]] = []
    for (model, source, stat), measure in itertools.product(stats, MEASURES):
        of: Summary = getattr(stat, measure)
        avg, median = (ends or (None, None) for ends in (of.avg_interval, of.median_interval))
        place = model, stat.alignment, stat.tone, measure, *(stat.cell or (None, None))
        rows.append((*place, of.n, of.max, of.min, of.avg, *avg, of.median, *median, of.below_ceiling, source))
    return csv_text(SUMMARY_COLUMNS, rows)


def terminal_tables(report: Report) -> Iterator[Table]:
    """Yield the tables for the terminal: averages; their extremes are on the page."""
    rows = [[*table_2(report, key), *robot_writing(report, key)] for key in (NORMAL, STRICT)]
    yield _terminal_table(f"averages, binary, ink = 1, percent ({report.label})", *rows)
    for title, tables in itertools.groupby(table_3(report), lambda table: table.character):
        yield _terminal_table(
            f"Table 3: {title}, averages, binary, percent ({report.label})", *(t.rows for t in tables)
        )


def _terminal_table(title: str, like: Sequence[TableRow], strict: Sequence[TableRow]) -> Table:
    """Each row in both alignments; the paper's numbers are of the first."""
    table = Table("model", "n", "size-\nnormalised\nCSIM / SSIM", "paper's\navg", "mm\nCSIM / SSIM", title=title)
    for row, other in itertools.zip_longest(like, strict):
        if row.scores is not None:
            words = [_pair(row.scores), "", "" if other is None else _pair(other.scores)]
            if row.paper is not None:
                words[1] = f"{row.paper.csim[2]:.2f} / {row.paper.ssim[2]:.2f}"
            table.add_row(row.label + SHORT.get(row.basis, ""), str(row.scores.csim.n), *words)
    return table


def _pair(scores: Stat | Table3Row | None) -> str:
    return "" if scores is None else f"{scores.csim.avg:.2f} / {scores.ssim.avg:.2f}"


class GateMissed(Exception):
    """A score misses its gate; the report is still written."""

    exit_code: ClassVar[int] = 5


def parse_gate(text: str) -> re.Match[str]:
    """The parts of a gate by name. Raises `CalibrationError`."""
    gate = GATE.fullmatch(text.strip())
    if gate is None or float(gate["limit"]) > 1.0:
        raise CalibrationError(f"--gate {text}", GATE_RULE)
    return gate


def check_gates(report: Report, gates: Sequence[str]) -> None:
    """Check the gates; one that names no model is for the report's calibrated model, or else for the first.

    Raises `GateMissed` naming all missed ones, `CalibrationError` for a score that is not there.
    """
    missed: list[str] = []
    for gate in map(parse_gate, gates):
        model, measure, statistic = gate["model"] or report.shown, gate["measure"], gate["statistic"]
        key = Alignment(gate["alignment"] or NORMAL[0]), Tone(gate["tone"] or NORMAL[1])
        stat = report.stat(model, key)
        percent: float | None = None if stat is None else getattr(getattr(stat, measure), statistic)
        if percent is None:
            known = ", ".join(dict.fromkeys(stat.model for stat in report.stats))
            raise CalibrationError(f"--gate {gate[0]}", f"{model!r} has no {statistic}; scored: {known}")
        if 0.01 * percent < float(gate["limit"]):
            which = f"{measure}_{statistic} of {', '.join((model, *key))}"
            missed.append(f"{gate[0]}: {which} is {0.01 * percent:.4f} ({report.label})")
    if missed:
        raise GateMissed(f"gate missed: {'; '.join(missed)}")
