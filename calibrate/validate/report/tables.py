"""The rows of every table, for both terminal and page."""

from __future__ import annotations

from dataclasses import dataclass

from brushloop.calibrate.compare.paper import TABLE_1, TABLE_2, Printed
from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.compare.score import Polarity
from brushloop.calibrate.loop.scores import AGAIN, LoopRecord
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate import candidates as who
from brushloop.calibrate.validate.report.data import CandidateInfo, Report, Stat
from brushloop.calibrate.validate.run import ANOTHER as ANOTHER_PRESS
from brushloop.calibrate.validate.run import REPEATED
from brushloop.calibrate.writing.scores import ANOTHER, PLANNED, REFERENCE, SIMULATED, Table3Row, WrittenRecord

MISSING = {
    "ccd-bsmg": "not in this run: give a trained one with --generator",
    REPEATED: "not in this run: “brushloop loop SESSION --config RIG” presses recovered strokes again; then validate "
    "again",
}
WRITTEN_ROWS = {
    SIMULATED: ("simulated", "each writing against the model's image of its plan"),
    REFERENCE: ("robot writing", "each writing against the reference"),
    ANOTHER: ("another writing", "each writing against the others: how repeatable arm and brush are"),
    PLANNED: ("the plan", "simulated image against the reference: the best that the plan could give"),
}
"""Label and description of the row of Table 3 for each comparison."""


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One row in the paper's layout: CSIM max, min, avg, then SSIM; None if one side has no such row.

    The ceiling has an average only.
    """

    label: str
    basis: str
    n: int
    ours: tuple[float | None, ...] | None
    paper: tuple[float, ...] | None
    ceiling: bool


@dataclass(frozen=True, slots=True)
class FullRow:
    """CSIM and SSIM of one model with all their statistics."""

    label: str
    csim: Stat
    ssim: Stat
    ceiling: bool


def table_1(report: Report, alignment: Alignment, tone: Tone) -> list[PaperRow]:
    """Rows of the generated models and robot writing, with calibrated models and the ceiling."""
    names = [*TABLE_1, *_present(report, (who.FITTED_HELD_OUT, who.GENERATOR_HELD_OUT))]
    names += [ANOTHER_PRESS, CEILING]
    rows: list[PaperRow] = []
    for name in names:
        again = robot_writing(report, alignment, tone) if name == REPEATED else []
        rows += again or [_row(report, name, TABLE_1.get(name), alignment, tone)]
    return rows


def robot_writing(report: Report, alignment: Alignment, tone: Tone) -> list[PaperRow]:
    """Rows of strokes pressed again: scored in this run if it has both sessions, else taken from each loop."""
    scored = report.stat(REPEATED, alignment, tone, "csim") is not None
    rows = [_row(report, REPEATED, TABLE_1[REPEATED], alignment, tone)] if scored else []
    here = {session.recording_sha256 for session in report.sessions}
    for loop in report.loops:
        if not (scored and loop.again_sha256 in here):
            rows += _loop_row(loop, report, alignment, tone)
    return rows


def _loop_row(loop: LoopRecord, report: Report, alignment: Alignment, tone: Tone) -> list[PaperRow]:
    row = loop.row(AGAIN, alignment, tone)
    if row is None:
        return []
    basis = f"{loop.original} pressed again as {loop.again}, recovered by {loop.model}"
    if loop.mm_per_px != report.mm_per_px and alignment is Alignment.MM:
        basis += f"; at {loop.mm_per_px:g} mm per pixel"
    printed = TABLE_1[REPEATED]
    ours, paper = (*row.csim, *row.ssim), (*printed.csim, *printed.ssim)
    return [PaperRow(printed.label, basis, row.n, ours, paper, ceiling=False)]


def table_2(report: Report, alignment: Alignment, tone: Tone) -> list[PaperRow]:
    """Rows of the paper's models in its order, then of all others."""
    last = (ANOTHER_PRESS, CEILING)
    others = [rival.name for rival in report.rivals if rival.name not in (*TABLE_2, *last, REPEATED, *who.LAMBDAS)]
    names = [*TABLE_2, *others, *last]
    return [_row(report, name, TABLE_2.get(name), alignment, tone) for name in names]


@dataclass(frozen=True, slots=True)
class CharacterTables:
    """One character of Table 3."""

    character: str
    title: str
    """Character, session, brush and cell."""
    paper_like: list[PaperRow]
    """Size-normalised and binary, in both polarities, with the paper's rows."""
    strict: list[PaperRow]
    """In millimetres, binary, ink = 1."""


def table_3(report: Report) -> list[CharacterTables]:
    """Tables of every character in every session of characters."""
    found: list[CharacterTables] = []
    for record in report.written:
        for name in record.characters:
            rows = [row for row in record.table_3 if (row.character, row.tone) == (name, Tone.BINARY)]
            normal, strict = (
                {(row.polarity, row.pair): row for row in rows if row.alignment is alignment}
                for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM)
            )
            like = [normal.get((Polarity.INK, pair)) for pair in WRITTEN_ROWS]
            like += [normal.get((Polarity.PAPER, pair)) for pair in (SIMULATED, REFERENCE)]
            own = [strict.get((Polarity.INK, pair)) for pair in WRITTEN_ROWS]
            found.append(
                CharacterTables(
                    name,
                    _written_title(name, record),
                    [_written_row(row, beside=True) for row in like if row is not None],
                    [_written_row(row, beside=False) for row in own if row is not None],
                )
            )
    return found


def _written_title(name: str, record: WrittenRecord) -> str:
    brush = record.brush or "an unnamed brush"
    return f"{name}, written in {record.session} with {brush} on paper cells of {record.cell_mm:g} mm"


def _written_row(row: Table3Row, *, beside: bool) -> PaperRow:
    label, what = WRITTEN_ROWS[row.pair]
    what += {SIMULATED: f", {row.model}", REFERENCE: f", {row.reference}"}.get(row.pair, "")
    paper = None
    if beside and row.paper_csim is not None and row.paper_ssim is not None:
        paper = (*row.paper_csim, *row.paper_ssim)
        what += f" (beside the paper's {row.paper_row})"
    return PaperRow(
        label, f"{row.polarity}; {what}", row.n, (*row.csim, *row.ssim), paper, row.pair in (ANOTHER, PLANNED)
    )


def full(report: Report, alignment: Alignment, tone: Tone) -> list[FullRow]:
    """Rows of all models."""
    rows: list[FullRow] = []
    for rival in report.rivals:
        csim, ssim = (report.stat(rival.name, alignment, tone, measure) for measure in ("csim", "ssim"))
        if csim is not None and ssim is not None:
            rows.append(FullRow(rival.label, csim, ssim, rival.name == CEILING))
    return rows


def pair(report: Report, name: str, alignment: Alignment) -> str:
    """Average `CSIM / SSIM`, binary; empty if there is none."""
    found = [report.stat(name, alignment, Tone.BINARY, measure) for measure in ("csim", "ssim")]
    return " / ".join(f"{stat.avg:.2f}" for stat in found if stat is not None)


def candidate(report: Report, name: str) -> CandidateInfo | None:
    """The candidate of that name, if there is one."""
    return next((one for one in report.rivals if one.name == name), None)


def _present(report: Report, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if candidate(report, name) is not None]


def _row(report: Report, name: str, printed: Printed | None, alignment: Alignment, tone: Tone) -> PaperRow:
    csim, ssim = (report.stat(name, alignment, tone, measure) for measure in ("csim", "ssim"))
    known = candidate(report, name)
    ours = None
    if csim is not None and ssim is not None:
        ours = (csim.max, csim.min, csim.avg, ssim.max, ssim.min, ssim.avg)
    label = known.label if known is not None else printed.label if printed is not None else name
    basis = known.basis if known is not None and ours is not None else MISSING.get(name, "not in this run")
    paper = (*printed.csim, *printed.ssim) if printed is not None else None
    return PaperRow(label, basis, csim.n if csim is not None else 0, ours, paper, name == CEILING)
