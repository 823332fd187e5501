"""Tables 1 to 3, and the report as data: what was validated with what, and the statistics of every model.

Terminal, page, summary.csv, gates and comparisons are made of it. A gate is a score that must be reached, as
`csim_avg>=0.90` or `ccd-bsm-heldout:mm:binary:csim_avg>=0.93`.
"""

from __future__ import annotations

import itertools
import platform
import re
from collections.abc import Collection, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare import (
    MM_PER_PX,
    NORMAL,
    ROBOT_WRITING,
    STRICT,
    TABLE_1,
    TABLE_2,
    Alignment,
    Key,
    Polarity,
    Printed,
    Tone,
)
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.loop import AGAIN, LoopRecord
from brushloop.calibrate.report import Sealed, source_label
from brushloop.calibrate.scores import MEASURES, Scores, Stat, statistics
from brushloop.calibrate.session import Calibration
from brushloop.calibrate.stats import CEILING, Floats, Summary, ceiling_values
from brushloop.calibrate.validate import run
from brushloop.calibrate.validate.run import ANOTHER, FITTED_HELD_OUT, FittedSession, ModelInfo, Outcome, Refused, Step
from brushloop.calibrate.writing.compare import ANOTHER as ANOTHER_WRITING
from brushloop.calibrate.writing.compare import PAPER_ROWS, PLANNED, REFERENCE, SIMULATED, Table3Row, WrittenRecord
from brushloop.model.presses import DepthTilt
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.sessions.disk import csv_text
from brushloop.sessions.events import CaptureResult, DipResult, ZeroTouchResult
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.records import Header, Source, Stroke
from brushloop.sessions.show import details

PACKAGES = ("brushloop", "numpy", "opencv-python-headless", "scikit-image", "numba", "torch")
MISSING = {
    "ccd-bsmg": "not in this run: give a generator trained for a brush of this size with --generator",
    ROBOT_WRITING: "not in this run: “brushloop repress SESSION” presses recovered strokes again; then validate again",
}
WRITTEN_ROWS = {
    SIMULATED: ("simulated", "each writing against the model's image of its plan"),
    REFERENCE: ("robot writing", "each writing against the reference"),
    ANOTHER_WRITING: ("another writing", "each writing against the others: how repeatable arm and brush are"),
    PLANNED: ("the plan", "simulated image against the reference: the best that the plan could give"),
}
"""Label and description of the row of Table 3 for each comparison."""
SUMMARY_COLUMNS = (
    *("model", "alignment", "tone", "measure", "depth_mm", "tilt_deg", "n", "max", "min"),
    *("avg", "avg_low", "avg_high", "median", "below_ceiling", "source"),
)
GATE = re.compile(
    r"((?P<model>[^:<>=]+):)??((?P<alignment>mm|size-normalised):)?((?P<tone>binary|gray):)?"
    r"(?P<measure>csim|ssim)_(?P<statistic>avg|median|min|max)\s*>=\s*(?P<limit>0|1|[01]?\.\d+)"
)
GATE_RULE = "must be like csim_avg>=0.90 or ccd-bsm:mm:gray:ssim_min>=0.5 (avg, median, min or max; 0 to 1)"


class Collected(Frozen):
    """How the strokes were collected, from the session's journal."""

    planned: int | None
    """Number of strokes; None unless the protocol is a grid."""
    photographed: int
    pressed_again: tuple[str, ...]
    """Stroke of each take that did not count and was repeated."""
    left_out: tuple[str, ...]
    touches: tuple[str, ...]
    """Method and height of every zero touch."""
    moved_mm: float
    """Highest minus lowest height of the paper."""


class Session(Frozen):
    """A recording, and the artefacts that were used with it."""

    header: Header
    recording: str
    recording_sha256: str
    strokes: int
    compared: int
    cut: tuple[str, ...]
    calibration: Calibration | None
    fit: str
    deepest_miss: Stroke | None = None
    """The stroke whose reached depth differs most from the commanded one; None where none is recorded."""
    collected: Collected | None = None
    """None without a journal: for imports, and for recordings sent without it."""


class Report(Sealed):
    """All results of a validation."""

    FILE: ClassVar[str] = "report.json"
    FORMAT: ClassVar[str] = "brushloop-validation-5"
    MADE_BY: ClassVar[str] = "brushloop validate"

    source: Source
    """Kind of ink, from the recordings' own headers; shown on all tables and figures."""
    software: dict[str, str]
    command: str
    mm_per_px: float
    ssim_settings: str
    sessions: tuple[Session, ...]
    models: tuple[ModelInfo, ...]
    """Rows of the tables: models, then comparisons with presses."""
    shown: str
    """Model shown in the pictures: the best calibrated one on held-out conditions, if there is one."""
    stats: tuple[Stat, ...]
    """Over all conditions, and in each."""
    refused: tuple[Refused, ...]
    by_strokes: tuple[Step, ...]
    """Similarity against number of strokes; empty without --ablations."""
    scores_sha256: str
    """Hash of scores.csv in the same folder."""
    loops: tuple[LoopRecord, ...] = ()
    """Strokes of these sessions that were pressed again: the third row of Table 1."""
    written: tuple[WrittenRecord, ...] = ()
    """Characters: Table 3. Each record here and in `loops` keeps its own digest."""

    def stat(self, model: str, key: Key = STRICT, condition: DepthTilt | None = None) -> Stat | None:
        """The scores of one model, or None if it has none."""
        wanted = (model, *key, condition)
        return next((stat for stat in self.stats if (stat.model, stat.alignment, stat.tone, stat.cell) == wanted), None)

    def model(self, name: str) -> ModelInfo | None:
        """The model of that name, or None if it has no score."""
        return next((model for model in self.models if model.name == name), None)

    @property
    def lost(self) -> list[tuple[str, str]]:
        """Session and name of each stroke that could not be used."""
        return sorted({press[:2] for press in self.refused if run.NOT_PREDICTED not in press.why})

    @property
    def label(self) -> str:
        """Label of every table and figure."""
        return source_label(self.source, (session.header.brush for session in self.sessions))


def report_of(outcome: Outcome, scores_sha256: str, beside: Collection[LoopRecord | WrittenRecord] = ()) -> Report:
    """Build one frozen report of a whole run, with the loops and characters that belong to it."""
    stats = tuple(_stats(outcome.scores))
    scored = {stat.model for stat in stats}
    present = [name for name in (*outcome.scores.models, CEILING) if name in scored]
    order = (FITTED_HELD_OUT, run.FITTED, "ccd-bsmg", "ccd-bsm", *present)
    report = Report(
        source=outcome.sessions[0].header.source,
        software={name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        command=outcome.request.command,
        mm_per_px=MM_PER_PX,
        ssim_settings=SSIM_SETTINGS,
        sessions=tuple(_session(session, outcome.scores) for session in outcome.sessions),
        models=tuple(_models(outcome, present)),
        shown=next((name for name in order if name in present), ""),
        stats=stats,
        refused=tuple(outcome.refused),
        by_strokes=tuple(outcome.steps),
        scores_sha256=scores_sha256,
        loops=tuple(record for record in beside if isinstance(record, LoopRecord)),
        written=tuple(record for record in beside if isinstance(record, WrittenRecord)),
    )
    return report.sealed()


def _stats(scores: Scores) -> Iterator[Stat]:
    """Yield the statistics of all conditions together, then of each."""
    another = 100.0 * scores.of(ANOTHER)
    ceiling: Floats = np.apply_along_axis(ceiling_values, 0, another, scores.group_of)
    percent = {model: 100.0 * scores.of(model) for model in scores.models} | {CEILING: ceiling}
    for model, values in percent.items():
        yield from statistics(model, values, scores.group_of, None, None if model in run.PRESS_ROWS else ceiling)
    for condition, at in scores.conditions().items():
        for model, values in percent.items():
            yield from statistics(model, values[at], scores.group_of[at], (condition.depth_mm, condition.tilt_deg))


def _models(outcome: Outcome, present: Sequence[str]) -> Iterator[ModelInfo]:
    """Yield every model that was compared, with what it knew of the presses of each session; then the other rows."""
    for name in outcome.scores.models:
        infos = [model.info for group in outcome.models.values() for model in group if model.info.name == name]
        if infos:
            yield infos[-1].model_copy(update={"basis": "; ".join(dict.fromkeys(info.basis for info in infos))})
    for name, definition in run.PRESS_ROWS.items():
        if name in present:
            yield ModelInfo(name=name, label=name, definition=definition, basis=run.PRESSES)


def _session(session: FittedSession, scores: Scores) -> Session:
    presses = [press for press in scores.presses if press.session == session.header.session_id]
    return Session(
        header=session.header,
        recording=session.recording.path.name,
        recording_sha256=session.sha256,
        strokes=len(session.strokes),
        compared=len(presses),
        cut=tuple(press.stroke.stroke_id for press in presses if press.cut),
        calibration=session.calibration,
        fit="" if session.fit is None else session.fit.digest,
        deepest_miss=max((press.stroke for press in presses), key=missed_mm, default=None),
        collected=collected_in(session.recording.path.parent),
    )


def missed_mm(stroke: Stroke) -> float:
    """How far the reached depth is from the commanded one; 0 where one of them is not known."""
    return 0.0 if stroke.depth_mm is None or stroke.reached_mm is None else abs(stroke.reached_mm - stroke.depth_mm)


def collected_in(folder: Path) -> Collected | None:
    """How the strokes of a folder were collected; None for a recording without a journal. Raises `SessionDamaged`."""
    if not (folder / JOURNAL_NAME).is_file():
        return None
    state = replay(folder / JOURNAL_NAME)
    captures, touches = state.results(CaptureResult), state.results(ZeroTouchResult)
    rejected = [capture for capture in captures if not capture.kept]
    skipped = [dip.skipped for dip in state.results(DipResult) if dip.skipped is not None]
    left_out = [*(capture.press for capture in rejected if not capture.retake), *skipped]
    heights_mm = [touch.touch_z_mm for touch in touches] or [0.0]
    return Collected(
        planned=details(folder).planned,
        photographed=len(captures),
        pressed_again=tuple(capture.press.stroke_id for capture in rejected if capture.retake),
        left_out=tuple(press.stroke_id for press in left_out),
        touches=tuple(f"{touch.method} {touch.touch_z_mm:.2f} mm" for touch in touches),
        moved_mm=round(max(heights_mm) - min(heights_mm), 6),
    )


class TableRow(NamedTuple):
    """One row in the paper's layout."""

    label: str
    basis: str
    scores: Stat | Table3Row | None
    """None if only the paper has such a row."""
    paper: Printed | None = None
    soft: bool = False
    """Whether it is what a model may be compared with, not a model: the ceiling, another writing, the plan."""


def table_1(report: Report) -> list[TableRow]:
    """Rows of the generated models and robot writing, with calibrated models and the ceiling."""
    calibrated = [FITTED_HELD_OUT] if report.model(FITTED_HELD_OUT) is not None else []
    rows = [_row(report, name, TABLE_1[name]) for name in TABLE_1 if name != ROBOT_WRITING]
    rows += robot_writing(report) or [_row(report, ROBOT_WRITING, TABLE_1[ROBOT_WRITING])]
    return rows + [_row(report, name) for name in (*calibrated, ANOTHER, CEILING)]


def robot_writing(report: Report, key: Key = NORMAL) -> list[TableRow]:
    """Rows of strokes pressed again, one of each loop."""
    basis, paper = "{0.original} pressed again as {0.again}, recovered by {0.model}", TABLE_1[ROBOT_WRITING]
    again = [(loop, stat) for loop in report.loops for stat in loop.rows(key) if stat.model == AGAIN]
    return [TableRow(ROBOT_WRITING, basis.format(loop), stat, paper) for loop, stat in again]


def table_2(report: Report, key: Key = NORMAL) -> list[TableRow]:
    """Rows of the paper's models in its order, then of all others."""
    last = (ANOTHER, CEILING)
    others = [model.name for model in report.models if model.name not in (*TABLE_2, *last, *run.LAMBDAS)]
    return [_row(report, name, TABLE_2.get(name), key) for name in (*TABLE_2, *others, *last)]


def _row(report: Report, name: str, paper: Printed | None = None, key: Key = NORMAL) -> TableRow:
    known = report.model(name)
    label = known.label if known is not None else paper.label if paper is not None else name
    basis = known.basis if known is not None else MISSING.get(name, "not in this run")
    return TableRow(label, basis, report.stat(name, key), paper, name == CEILING)


def table_3(record: WrittenRecord, character: str, alignment: Alignment) -> list[TableRow]:
    """Rows of a character, binary: size-normalised in both polarities, with the paper's rows, or in mm with ink = 1."""
    like = alignment is Alignment.SIZE_NORMALISED
    keys = [(Polarity.INK, pair) for pair in WRITTEN_ROWS]
    keys += [(Polarity.PAPER, pair) for pair in PAPER_ROWS] if like else []
    of_character = [row for row in record.table_3 if (row.character, row.tone) == (character, Tone.BINARY)]
    rows = {(row.polarity, row.pair): row for row in of_character if row.alignment is alignment}
    table: list[TableRow] = []
    for row in (rows[key] for key in keys if key in rows):
        label, basis = WRITTEN_ROWS[row.pair]
        basis += {SIMULATED: f", {record.model}", REFERENCE: f", {row.reference}"}.get(row.pair, "")
        paper = PAPER_ROWS.get(row.pair) if like else None
        if paper is not None:
            basis += f" (beside the paper's {paper.label})"
        table.append(TableRow(f"{label}, {row.polarity}", basis, row, paper, row.pair not in PAPER_ROWS))
    return table


def summary_csv(report: Report) -> str:
    """Return every statistic, per condition and overall; “robot writing” is what `brushloop repress` pressed again."""
    stats = [(stat.model, report.label, stat) for stat in report.stats]
    for loop in report.loops:
        again = (stat for stat in loop.stats if stat.model == AGAIN)
        stats += [(f"{ROBOT_WRITING} ({loop.again})", str(loop.source), stat) for stat in again]
    rows: list[tuple[object, ...]] = []
    for (model, source, stat), measure in itertools.product(stats, MEASURES):
        of: Summary = getattr(stat, measure)
        interval = of.avg_interval or (None, None)
        place = model, stat.alignment, stat.tone, measure, *(stat.cell or (None, None))
        below = None if stat.model == AGAIN else of.below_ceiling  # that of a loop is below another press
        rows.append((*place, of.n, of.max, of.min, of.avg, *interval, of.median, below, source))
    return csv_text(SUMMARY_COLUMNS, rows)


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
            raise CalibrationError(f"--gate {gate[0]}", f"{model!r} has no {statistic}; models with scores: {known}")
        if 0.01 * percent < float(gate["limit"]):
            which = f"{measure}_{statistic} of {', '.join((model, *key))}"
            missed.append(f"{gate[0]}: {which} is {0.01 * percent:.4f} ({report.label})")
    if missed:
        raise GateMissed(f"gate missed: {'; '.join(missed)}")
