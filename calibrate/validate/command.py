"""`brushloop validate`: from sessions to the files of a report; and `diff`, two reports compared.

A difference is tested in pairs. These are, in order of preference: the same stroke of the same recording (two software
versions, or two sets of options); the averages of the same condition in two sessions.
"""

from __future__ import annotations

import csv
import hashlib
import shlex
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
from filelock import FileLock, Timeout
from rich.table import Table

from brushloop.calibrate.artefact import FITS, current
from brushloop.calibrate.commands import DiffRequest, ValidateRequest
from brushloop.calibrate.drags.report import DragValidation, validate_drags, write_drags
from brushloop.calibrate.drags.report import summary as drag_summary
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.command import BrushFit
from brushloop.calibrate.loop import LoopRecord
from brushloop.calibrate.report import data_uri, framed, write_files
from brushloop.calibrate.scores import MEASURES, scores_csv, write_parquet
from brushloop.calibrate.session import open_session as open_recording
from brushloop.calibrate.stats import Paired, holm, paired
from brushloop.calibrate.validate.page import Curve, page_of, read_curve, terminal_lines, verdict
from brushloop.calibrate.validate.run import FittedSession, Outcome, Refused, validate_presses
from brushloop.calibrate.validate.tables import Report, check_gates, parse_gate, report_of, summary_csv
from brushloop.calibrate.work import cluster, threads
from brushloop.calibrate.writing.compare import PICTURE, WrittenRecord
from brushloop.sessions.disk import as_text, check_writable, csv_text, file_sha256, read_bounded
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen

FOLDER = "validation"
LOCK = ".lock"
LOOP, WRITTEN = "loop", "written"
"""Folders of a session, where its loop and its characters are looked for; `written` also beside all sessions."""
MAX_PICTURE_BYTES = 16 * 1024 * 1024
SIGNIFICANT = 0.05
Series = tuple[str, str, str, str]
"""Model, alignment, tone, measure."""
Beside = dict[Path, LoopRecord | WrittenRecord]
"""The loops and characters that belong to the sessions of a report, by their files."""


@dataclass(frozen=True, slots=True)
class ValidationOutput:
    """Written output: a report of presses, or of one session of drags."""

    folder: Path
    report: Report | None = None
    drags: DragValidation | None = None
    notes: tuple[str, ...] = ()
    """What was found beside the sessions and left out, and why."""
    gates: tuple[str, ...] = ()

    @property
    def page(self) -> Path:
        """The report's page."""
        return self.folder / "report.html"

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        if self.drags is not None:
            yield from drag_summary(self.drags)
        if self.report is not None:
            yield from terminal_lines(self.report)
        yield from self.notes
        yield f"Report: {self.page}"

    @property
    def left_out(self) -> Sequence[tuple[str, str]]:
        """Strokes that could not be used."""
        return self.report.lost if self.report else self.drags.drags.refused if self.drags else ()

    def check(self) -> None:
        """Check the gates, once the report is written. Raises `GateMissed` if any is missed."""
        if self.gates and self.report is None:
            raise CalibrationError("--gate", "applies to presses, but this session holds drags")
        if self.report is not None:
            check_gates(self.report, self.gates)

    def _repr_html_(self) -> str:
        return framed(self.page)


def validate(
    request: ValidateRequest, progress: Progress = unseen, opened: Sequence[Recording] = ()
) -> ValidationOutput:
    """Validate and write every file of the report; its gates are checked afterwards, by `ValidationOutput.check`.

    Raises `CalibrationError`, and what reading a recording raises. Finished work is kept in the folders
    of the sessions, so that the same command resumes. `opened` are their recordings, where these are open already.
    """
    for text in request.gates:
        parse_gate(text)
    curves = [read_curve(text) for text in request.curves]
    place, *others = request.places
    home = Path() if others else place if place.is_dir() else place.parent
    folder = request.out or home / FOLDER
    check_writable(folder)
    sessions = [open_session(place, request.fit) for place in opened or request.places]
    one_source(sessions)
    kinds = {stroke.kind for session in sessions for stroke in session.strokes}
    if len(kinds) > 1:
        raise CalibrationError(str(sessions[-1].recording.path), "mixes presses and drags: validate them separately")
    if kinds == {"drag"}:
        if len(sessions) > 1:
            raise CalibrationError(str(sessions[1].recording.path), "holds drags: validate one such session at a time")
        drags = validate_drags(sessions[0].recording.path, request.fit, progress)
        write_drags(drags, folder, request.command)
        return ValidationOutput(folder, drags=drags, gates=request.gates)
    beside, notes = find_beside(sessions)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with (
            FileLock(folder / LOCK, timeout=0),
            cluster(request.scheduler) if request.scheduler else threads(request.workers) as scheduler,
        ):
            outcome = validate_presses(sessions, request, scheduler, progress)
            report = _write(outcome, folder, curves, beside)
    except Timeout:
        raise CalibrationError(str(folder), "another validation is writing in this folder") from None
    return ValidationOutput(folder, report, notes=tuple(notes), gates=request.gates)


def open_session(place: Path | Recording, fit: Path | None = None) -> FittedSession:
    """Open a session. Raises `CalibrationError`, `InputError` or `SessionDamaged`, each naming it."""
    session = open_recording(place)
    path = session.recording.path
    closed = replay(path.parent / JOURNAL_NAME).closed if (path.parent / JOURNAL_NAME).is_file() else None
    if closed is not None and closed.sha256 != session.sha256:
        raise SessionDamaged(path, "is not the file that the session was closed with: its SHA-256 differs")
    # A fit of drags is read with the strokes that it predicts.
    used = None if session.strokes[0].kind == "drag" else fit or current(path.parent, FITS)
    brush = None if used is None else BrushFit.read(used)
    return FittedSession(session.recording, session.sha256, session.strokes, session.calibration, session.store, brush)


def one_source(sessions: Sequence[FittedSession]) -> None:
    """Check that all recordings have one kind of ink. Raises `CalibrationError` if they differ."""
    first = sessions[0]
    for other in sessions[1:]:
        if other.header.source != first.header.source:
            what = f"has the source {other.header.source}, but {first.recording.path.name} has {first.header.source}"
            raise CalibrationError(str(other.recording.path), f"{what}: validate them separately")


def find_beside(sessions: Sequence[FittedSession]) -> tuple[Beside, list[str]]:
    """Read the loop and the characters in each session's folder, and the characters beside the folder of sessions.

    Those of other strokes, another brush or another kind of ink are left out, and returned in words. Raises
    `CalibrationError` for an edited file.
    """
    beside, notes, source = Beside(), list[str](), sessions[0].header.source
    brushes, originals = {session.header.brush for session in sessions}, {session.sha256 for session in sessions}
    homes = list(dict.fromkeys(session.recording.path.resolve().parent for session in sessions))
    places = dict.fromkeys(place for home in homes for place in (home, home.parent.parent))
    written = [place / WRITTEN / WrittenRecord.FILE for place in places]
    for path in (*(home / LOOP / LoopRecord.FILE for home in homes), *written):
        if not path.is_file():
            continue
        record = WrittenRecord.read(path) if path in written else LoopRecord.read(path)
        if record.source != source:
            foreign = f"its source is {record.source}, not {source}"
        elif isinstance(record, LoopRecord):
            known = record.original_sha256 in originals
            foreign = "" if known else f"it belongs to another recording of {record.original}"
        else:
            foreign = "" if {record.brush} == brushes else f"it was written with another brush, {record.brush}"
        if foreign:
            notes.append(f"{path} is left out: {foreign}; `{record.MADE_BY}` makes it again")
        else:
            beside[path] = record
    return beside, notes


def figure_13(path: Path, record: WrittenRecord) -> str:
    """Figure 13 as a data URI. Raises `CalibrationError` unless it is the picture written with the record."""
    data = read_bounded(path, MAX_PICTURE_BYTES)
    if hashlib.sha256(data).hexdigest() != record.figure_13_sha256:
        raise CalibrationError(str(path), f"is not the picture of {record.FILE} beside it: its SHA-256 differs")
    return data_uri(data)


def _write(outcome: Outcome, folder: Path, curves: Sequence[Curve], beside: Beside) -> Report:
    """Write the files of a report."""
    files = {"scores.csv": scores_csv(outcome.scores)}
    report = report_of(outcome, hashlib.sha256(files["scores.csv"].encode()).hexdigest(), beside.values())
    written = [(path, record) for path, record in beside.items() if isinstance(record, WrittenRecord)]
    figures_13 = [(record.session, figure_13(path.with_name(PICTURE), record)) for path, record in written]
    files["summary.csv"] = summary_csv(report)
    files["failures.csv"] = csv_text(Refused._fields, report.refused)
    files[report.FILE] = report.to_json()
    files["verdict.txt"] = f"{verdict(report)}\n"
    names = [*files, *write_parquet(outcome.scores, report.label, folder / "scores.parquet")]
    files["report.html"] = page_of(outcome, report, curves, names, figures_13)
    write_files(folder, files)
    return report


@dataclass(frozen=True, slots=True)
class Change:
    """One series, `after` minus `before` in points (percent)."""

    series: Series
    before: float
    after: float
    test: Paired
    p_holm: float
    """p-value corrected for the number of series compared."""

    @property
    def verdict(self) -> str:
        """`better`, `worse` or `no significant difference`, by `p_holm`."""
        if self.p_holm > SIGNIFICANT:
            return "no significant difference"
        return "better" if self.test.mean > 0 else "worse"


@dataclass(frozen=True, slots=True)
class Difference:
    """Two reports compared."""

    before: Report
    after: Report
    by_stroke: bool
    """Whether the same strokes are paired; else the averages of the same conditions."""
    changes: list[Change]

    def lines(self) -> Iterator[object]:
        """What the command prints: what is compared, and the changes."""
        for words, side in (("Before", self.before), ("After", self.after)):
            names = ", ".join(session.header.session_id for session in side.sessions[:4])
            yield f"{words}: {names}, brushloop {side.software['brushloop']}."
        what = "the same stroke" if self.by_stroke else "the average of the same (H, α)"
        test = self.changes[0].test
        yield (
            f"Each pair compares {what}; n = {test.n} in {test.groups} conditions. p comes from flipping the signs "
            f"of whole conditions, corrected by Holm's method for {len(self.changes)} series ({self.before.label})."
        )
        if not self.by_stroke:
            yield "Two sessions also differ in things that were not meant to change: brush, ink, paper, zero touch."
        title = f"after minus before, percentage points ({self.before.label})"
        table = Table("model", "images", "", "before", "after", "change", "95 %", "p", "", title=title)
        for change in self.changes:
            name, alignment, tone, measure = change.series
            span = change.test.interval
            table.add_row(
                *(name, f"{alignment}, {tone}", measure.upper(), f"{change.before:.2f}", f"{change.after:.2f}"),
                *(f"{change.test.mean:+.3f}", "" if span is None else f"{span[0]:+.2f} to {span[1]:+.2f}"),
                *(f"{change.p_holm:.3f}", change.verdict),
            )
        yield table


def compare(request: DiffRequest, _progress: Progress = unseen) -> Difference:
    """Compare two reports, or two validated sessions. Raises `CalibrationError` if they are not comparable."""
    paths = report_path(request.before), report_path(request.after)
    old, new = (Report.read(path) for path in paths)
    if old.source != new.source:
        what = f"has the source {new.source}, but {paths[0]} has {old.source}: they cannot be compared"
        raise CalibrationError(str(paths[1]), what)
    by_stroke = bool({s.recording_sha256 for s in old.sessions} & {s.recording_sha256 for s in new.sessions})
    first, last = (_scores(path, side, by_stroke=by_stroke) for path, side in zip(paths, (old, new), strict=True))
    found: list[tuple[Series, float, float, Paired]] = []
    for series in (series for series in first if series in last):
        both = sorted(first[series].keys() & last[series].keys())
        values = 100.0 * np.array([[side[series][key] for key in both] for side in (first, last)])
        # The error of a model is common to all strokes of a condition.
        conditions = np.unique([",".join(key[:2]) for key in both], return_inverse=True)[1]
        if both:
            test = paired(values[0], values[1], conditions)
            found.append((series, float(values[0].mean()), float(values[1].mean()), test))
    if not found:
        raise CalibrationError(str(paths[1]), f"has no stroke, condition or model in common with {paths[0]}")
    corrected = holm([test.p for *_, test in found])
    return Difference(old, new, by_stroke, [Change(*change, p) for change, p in zip(found, corrected, strict=True)])


def report_path(place: Path) -> Path:
    """Find report.json: the file given, or the one in a report's or session's folder.

    If there is none, raises `CalibrationError` that names the command to run.
    """
    for path in (place, place / Report.FILE, place / FOLDER / Report.FILE):
        if path.is_file() and path.suffix == ".json":
            return path
    why = f"was not validated: run `brushloop validate {shlex.quote(str(place))}` first, or give a report.json"
    raise CalibrationError(str(place), why)


def _scores(path: Path, report: Report, *, by_stroke: bool) -> dict[Series, dict[tuple[str, ...], float]]:
    """Read scores by condition, recording and stroke, or averaged by condition.

    Raises `CalibrationError` for an edited table.
    """
    table = path.with_name("scores.csv")
    if not table.is_file() or file_sha256(table) != report.scores_sha256:
        raise CalibrationError(str(table), f"is not the table of {path.name}: its SHA-256 differs")
    recordings = {s.header.session_id: s.recording_sha256 for s in report.sessions}
    scores: defaultdict[Series, defaultdict[tuple[str, ...], list[float]]] = defaultdict(lambda: defaultdict(list))
    with table.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            condition = (row["depth_mm"], row["tilt_deg"])
            key = (*condition, recordings[row["session_id"]], as_text(row["stroke_id"])) if by_stroke else condition
            for measure in MEASURES:
                scores[row["model"], row["alignment"], row["tone"], measure][key].append(float(row[measure]))
    return {series: {key: fmean(of_key) for key, of_key in keys.items()} for series, keys in scores.items()}
