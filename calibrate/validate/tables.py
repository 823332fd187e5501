"""Queries on a report and its scores: Tables 1 to 3, CSV and Parquet, tables for the terminal, and gates.

A gate is a limit that a score must meet, as `csim_avg>=0.90` or `ccd-bsm-heldout:mm:binary:csim_avg>=0.93`.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rich.table import Column, Table

from brushloop.calibrate.compare.paper import TABLE_1, TABLE_2, Printed
from brushloop.calibrate.compare.place import Alignment, Key, Tone
from brushloop.calibrate.compare.score import Polarity
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import replacing, write_whole
from brushloop.calibrate.loop.scores import AGAIN, LoopRecord
from brushloop.calibrate.report import source_label
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate.models import (
    ANOTHER,
    FITTED_HELD_OUT,
    GENERATOR_HELD_OUT,
    HELD_OUT,
    LAMBDAS,
    REPEATED,
)
from brushloop.calibrate.validate.report import MEASURES, Report, Stat
from brushloop.calibrate.validate.run import Outcome
from brushloop.calibrate.writing.scores import ANOTHER as ANOTHER_WRITING
from brushloop.calibrate.writing.scores import PLANNED, REFERENCE, SIMULATED, Table3Row, WrittenRecord
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
SCORE_COLUMNS = (
    *("session_id", "stroke_id", "depth_mm", "reached_mm", "tilt_deg", "model", "alignment", "tone"),
    *("csim", "ssim", "source"),
)
"""`depth_mm` was commanded; `reached_mm` is empty where the recording does not say what the arm reached."""
NUMBERS = ("depth_mm", "reached_mm", "tilt_deg", "csim", "ssim")
SUMMARY_COLUMNS = tuple(name for name in Stat.model_fields if name not in ("below_low", "below_high"))
OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}
STATISTICS = ("avg", "median", "min", "max")
GATE = re.compile(
    r"^(?P<where>(?:[^:<>=]+:)*)(?P<measure>csim|ssim)_(?P<statistic>\w+)\s*(?P<op>>=|<=|>|<)\s*(?P<limit>\S+)$"
)


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row in the paper's layout: CSIM max, min, avg, then SSIM; None if one side has no such row.

    The ceiling has an average only.
    """

    label: str
    basis: str
    n: int
    ours: tuple[float | None, ...] | None
    paper: tuple[float, ...] | None = None
    ceiling: bool = False


def table_1(report: Report, key: Key) -> list[TableRow]:
    """Rows of the generated models and robot writing, with calibrated models and the ceiling."""
    calibrated = [name for name in (FITTED_HELD_OUT, GENERATOR_HELD_OUT) if report.model(name) is not None]
    rows: list[TableRow] = []
    for name in (*TABLE_1, *calibrated, ANOTHER, CEILING):
        again = robot_writing(report, key) if name == REPEATED else []
        rows += again or [_row(report, name, TABLE_1.get(name), key)]
    return rows


def robot_writing(report: Report, key: Key) -> list[TableRow]:
    """Rows of strokes pressed again: scored in this run if it has both sessions, else taken from each loop."""
    scored = report.stat(REPEATED, *key, "csim") is not None
    rows = [_row(report, REPEATED, TABLE_1[REPEATED], key)] if scored else []
    here = {session.recording_sha256 for session in report.sessions}
    for loop in report.loops:
        if not (scored and loop.again_sha256 in here):
            rows += _loop_row(loop, report, key)
    return rows


def _loop_row(loop: LoopRecord, report: Report, key: Key) -> Iterator[TableRow]:
    row = loop.row(AGAIN, *key)
    if row is None:
        return
    basis = f"{loop.original} pressed again as {loop.again}, recovered by {loop.model}"
    if loop.mm_per_px != report.mm_per_px and key[0] is Alignment.MM:
        basis += f"; at {loop.mm_per_px:g} mm per pixel"
    printed = TABLE_1[REPEATED]
    yield TableRow(printed.label, basis, row.n, (*row.csim, *row.ssim), (*printed.csim, *printed.ssim))


def table_2(report: Report, key: Key) -> list[TableRow]:
    """Rows of the paper's models in its order, then of all others."""
    last = (ANOTHER, CEILING)
    others = [one.name for one in report.models if one.name not in (*TABLE_2, *last, REPEATED, *LAMBDAS)]
    return [_row(report, name, TABLE_2.get(name), key) for name in (*TABLE_2, *others, *last)]


def _row(report: Report, name: str, printed: Printed | None, key: Key) -> TableRow:
    csim, ssim = (report.stat(name, *key, measure) for measure in MEASURES)
    known = report.model(name)
    ours = None
    if csim is not None and ssim is not None:
        ours = (csim.max, csim.min, csim.avg, ssim.max, ssim.min, ssim.avg)
    label = known.label if known is not None else printed.label if printed is not None else name
    basis = known.basis if known is not None and ours is not None else MISSING.get(name, "not in this run")
    paper = (*printed.csim, *printed.ssim) if printed is not None else None
    return TableRow(label, basis, csim.n if csim is not None else 0, ours, paper, name == CEILING)


@dataclass(frozen=True, slots=True)
class CharacterTables:
    """One character of Table 3."""

    character: str
    title: str
    """Character, session, brush and cell."""
    paper_like: list[TableRow]
    """Size-normalised and binary, in both polarities, with the paper's rows."""
    strict: list[TableRow]
    """In millimetres, binary, ink = 1."""


def table_3(report: Report) -> list[CharacterTables]:
    """Tables of every character in every session of characters."""
    return [_of_character(name, record) for record in report.written for name in record.characters]


def _of_character(name: str, record: WrittenRecord) -> CharacterTables:
    rows = {
        (row.alignment, row.polarity, row.pair): row
        for row in record.table_3
        if (row.character, row.tone) == (name, Tone.BINARY)
    }
    like = [(Polarity.INK, pair) for pair in WRITTEN_ROWS]
    like += [(Polarity.PAPER, pair) for pair in (SIMULATED, REFERENCE)]
    normal = [rows.get((Alignment.SIZE_NORMALISED, *which)) for which in like]
    strict = [rows.get((Alignment.MM, Polarity.INK, pair)) for pair in WRITTEN_ROWS]
    brush = record.brush or "an unnamed brush"
    return CharacterTables(
        name,
        f"{name}, written in {record.session} with {brush} on paper cells of {record.cell_mm:g} mm",
        [_written_row(row, beside=True) for row in normal if row is not None],
        [_written_row(row, beside=False) for row in strict if row is not None],
    )


def _written_row(row: Table3Row, *, beside: bool) -> TableRow:
    label, what = WRITTEN_ROWS[row.pair]
    what += {SIMULATED: f", {row.model}", REFERENCE: f", {row.reference}"}.get(row.pair, "")
    paper = None
    if beside and row.paper_csim is not None and row.paper_ssim is not None:
        paper = (*row.paper_csim, *row.paper_ssim)
        what += f" (beside the paper's {row.paper_row})"
    basis, ceiling = f"{row.polarity}; {what}", row.pair in (ANOTHER_WRITING, PLANNED)
    return TableRow(label, basis, row.n, (*row.csim, *row.ssim), paper, ceiling)


def full(report: Report, key: Key) -> list[tuple[str, Stat, Stat]]:
    """Label, CSIM and SSIM of every model."""
    rows = [(one.label, *(report.stat(one.name, *key, measure) for measure in MEASURES)) for one in report.models]
    return [(label, csim, ssim) for label, csim, ssim in rows if csim is not None and ssim is not None]


def pair(report: Report, name: str, alignment: Alignment) -> str:
    """Average `CSIM / SSIM`, binary; empty if there is none."""
    stats = [report.stat(name, alignment, Tone.BINARY, measure) for measure in MEASURES]
    return " / ".join(f"{stat.avg:.2f}" for stat in stats if stat is not None)


def score_rows(outcome: Outcome) -> Iterator[tuple[object, ...]]:
    """Yield one row of `SCORE_COLUMNS` per score, by session and order of capture."""
    labels = {one.header.session_id: source_label(one.header.source, [one.header.brush]) for one in outcome.sessions}
    for s in outcome.scores:
        pressed = s.condition.depth_mm, s.reached_mm, s.condition.tilt_deg
        compared = s.model, str(s.alignment), str(s.tone), s.csim, s.ssim
        yield s.session, s.stroke_id, *pressed, *compared, labels[s.session]


def write_csv(outcome: Outcome, path: Path) -> str:
    """Write every score and return the file's SHA-256. Raises OSError and leaves no partial file."""
    rows = (
        [f"{v:.8f}" if name in MEASURES else v for name, v in zip(SCORE_COLUMNS, row, strict=True)]
        for row in score_rows(outcome)
    )
    text = csv_text(SCORE_COLUMNS, rows)
    write_whole(path, text)
    return hashlib.sha256(text.encode()).hexdigest()


def write_parquet(outcome: Outcome, path: Path) -> None:
    """Write the same rows as Parquet. Raises `CalibrationError` if pyarrow is not installed."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise CalibrationError("--parquet", "needs pyarrow: pip install 'brushloop[parquet]'") from None
    kinds = [pa.float64() if name in NUMBERS else pa.string() for name in SCORE_COLUMNS]
    label = source_label(outcome.sessions[0].header.source, (one.header.brush for one in outcome.sessions))
    schema: Any = pa.schema(list(zip(SCORE_COLUMNS, kinds, strict=True)), metadata={"source": label})
    columns = [list(column) for column in zip(*score_rows(outcome), strict=True)] or [[] for _ in SCORE_COLUMNS]
    with replacing(path) as part:
        pq.write_table(pa.table(columns, schema=schema), part)


def summary_csv(report: Report) -> str:
    """Return every statistic, per cell and overall; “robot writing” is what `brushloop loop` pressed again."""
    rows = [{name: getattr(stat, name) for name in SUMMARY_COLUMNS} | {"source": report.label} for stat in report.stats]
    for row in (row for loop in report.loops for row in loop.table_1 if row.what == AGAIN):
        about = {"model": f"{REPEATED} ({row.again})", "alignment": row.alignment, "tone": row.tone, "n": row.n}
        for measure, three, median in (("csim", row.csim, row.csim_median), ("ssim", row.ssim, row.ssim_median)):
            numbers = dict(zip(("max", "min", "avg"), three, strict=True)) | {"measure": measure, "median": median}
            rows.append(about | numbers | {"source": str(row.source)})
    head = (*SUMMARY_COLUMNS, "source")
    return csv_text(head, [[row.get(name) for name in head] for row in rows])


def table_3_csv(report: Report) -> str:
    """Return every row of Table 3, with the paper's numbers in the corresponding rows."""
    head = ["session_id", "character", "reference", "model", "compared", "alignment", "tone", "polarity", "n"]
    head += [f"{of}_{what}" for of in MEASURES for what in ("max", "min", "avg", "median")]
    head += ["paper_row", *(f"paper_{of}_{what}" for of in MEASURES for what in ("max", "min", "avg"))]
    none = ("", "", "")
    rows = [
        (
            *(row.session_id, row.character, row.reference, row.model, row.pair, row.alignment, row.tone, row.polarity),
            *(row.n, *row.csim, row.csim_median, *row.ssim, row.ssim_median),
            *(row.paper_row or "", *(row.paper_csim or none), *(row.paper_ssim or none), str(row.source)),
        )
        for record in report.written
        for row in record.table_3
    ]
    return csv_text((*head, "source"), rows)


def terminal_tables(report: Report) -> Iterator[Table]:
    """Yield the tables for the terminal."""
    for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM):
        title = f"{alignment}, binary, ink = 1, percent ({report.label})"
        key = alignment, Tone.BINARY
        rows = [row for row in (*table_2(report, key), *robot_writing(report, key)) if row.ours is not None]
        named = [(row.label + SHORT.get(row.basis, ""), row) for row in rows]
        yield _terminal_table(Column("model"), title, alignment, named)
    for one in table_3(report):
        for alignment, rows in ((Alignment.SIZE_NORMALISED, one.paper_like), (Alignment.MM, one.strict)):
            for polarity, group in itertools.groupby(rows, key=lambda row: row.basis.partition(";")[0]):
                title = f"Table 3: {one.character}, {alignment}, binary, {polarity}, percent ({report.label})"
                named = [(row.label, row) for row in group]
                yield _terminal_table(Column("", min_width=len("simulated")), title, alignment, named)


def _terminal_table(first: Column, title: str, alignment: Alignment, rows: Sequence[tuple[str, TableRow]]) -> Table:
    """A table of named rows; a narrow terminal has room for averages only."""
    # The paper's numbers stand only beside those that are made in the same way, as far as the paper describes it.
    with_paper = alignment is Alignment.SIZE_NORMALISED
    heads = ["CSIM\navg", "SSIM\navg"] if narrow() else ["CSIM\nmax", "min", "avg", "SSIM\nmax", "min", "avg"]
    table = Table(first, "n", *heads, *(["paper's avg"] if with_paper else []), title=title)
    for name, row in rows:
        ours = row.ours or ()
        words = ["" if score is None else f"{score:.2f}" for score in (ours[2::3] if narrow() else ours)]
        if with_paper:
            words.append(f"{row.paper[2]:.2f} / {row.paper[5]:.2f}" if row.paper is not None else "")
        table.add_row(name, str(row.n), *words)
    return table


class GateMissed(Exception):
    """A score misses its gate; the report is still written."""

    exit_code: ClassVar[int] = 5

    def __init__(self, missed: list[str]) -> None:
        self.missed = missed
        super().__init__("gate missed: " + "; ".join(missed))


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
    found = GATE.match(text.strip())
    if found is None:
        raise _bad_gate(text, "expected [MODEL:][ALIGNMENT:][TONE:]csim_avg>=0.90")
    model, alignment, tone = "", Alignment.SIZE_NORMALISED, Tone.BINARY
    for part in found["where"].split(":")[:-1]:
        if part in list(Alignment):
            alignment = Alignment(part)
        elif part in list(Tone):
            tone = Tone(part)
        elif not model:
            model = part
        else:
            raise _bad_gate(text, f"names two models, {model!r} and {part!r}")
    if found["statistic"] not in STATISTICS:
        raise _bad_gate(text, f"{found['statistic']!r} is not one of {', '.join(STATISTICS)}")
    try:
        limit = number(found["limit"])
    except ValueError:
        raise _bad_gate(text, f"{found['limit']!r} is not a number") from None
    if not 0.0 <= limit <= 1.0:
        raise _bad_gate(text, f"{limit:g} is outside 0 to 1")
    return Gate(text.strip(), model, (alignment, tone), found["measure"], found["statistic"], found["op"], limit)


def check_gates(report: Report, gates: Sequence[Gate]) -> None:
    """Check the gates. Raises `GateMissed` naming all missed ones, `CalibrationError` for a model without scores."""
    missed: list[str] = []
    for gate in gates:
        model = gate.model or report.shown
        stat = report.stat(model, *gate.key, gate.measure)
        if stat is None:
            known = ", ".join(dict.fromkeys(one.model for one in report.stats))
            raise _bad_gate(gate.text, f"{model!r} has no score; scored: {known}")
        percent: float | None = getattr(stat, gate.statistic)
        if percent is None:
            raise _bad_gate(gate.text, f"the {model} is an average and has no {gate.statistic}")
        if not OPERATORS[gate.op](0.01 * percent, gate.limit):
            which = f"{gate.measure}_{gate.statistic} of {', '.join((model, *gate.key))}"
            missed.append(f"{gate.text}: {which} is {0.01 * percent:.4f} ({report.label})")
    if missed:
        raise GateMissed(missed)


def _bad_gate(text: str, what: str) -> CalibrationError:
    return CalibrationError(f"--gate {text}", what)
