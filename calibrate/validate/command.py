"""`brushloop validate`: from the locations of sessions to the files of a report."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from brushloop.calibrate.drags.captures import measure_drags
from brushloop.calibrate.drags.report import DragValidation, predict_session, write_drags
from brushloop.calibrate.drags.report import summary as drag_summary
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.pool import cluster, threads
from brushloop.calibrate.report import framed, source_label, source_note, write_files
from brushloop.calibrate.stroke.params import Params
from brushloop.calibrate.validate import findings, tables
from brushloop.calibrate.validate.inputs import URL, Extras, FittedSession, find_extras, one_source, open_session
from brushloop.calibrate.validate.page import Curve, page_of, pages_beside, read_curve
from brushloop.calibrate.validate.report import Report, report_of
from brushloop.calibrate.validate.run import Options, Outcome, Refused, validate_presses
from brushloop.sessions.disk import check_writable, csv_text
from brushloop.sessions.terminal import Progress, counted, unseen

FOLDER = "validation"
WORK = "work"
SCORES, PARQUET, TABLE_3 = "scores.csv", "scores.parquet", "table3.csv"
MAX_REFUSED = 20
"""Refused strokes listed on the terminal."""


@dataclass(frozen=True, slots=True)
class Request(Options):
    """What the command line asked for."""

    places: tuple[str, ...] = ()
    command: str = ""
    """Named by the report as what made it."""
    calibration: Path | None = None
    fit: Path | None = None
    curves: tuple[str, ...] = ()
    gates: tuple[str, ...] = ()
    parquet: bool | None = None
    """None writes it if pyarrow is installed."""
    loops: tuple[Path, ...] = ()
    written: tuple[Path, ...] = ()
    beside: bool = True
    """Whether loops and characters found with the sessions are used where none are named."""
    out: Path | None = None
    scheduler: str = ""
    workers: int | None = None


@dataclass(frozen=True, slots=True)
class ValidationOutput:
    """Written output: one report of presses, or one for each session of drags."""

    folder: Path
    report: Report | None = None
    drags: tuple[DragValidation, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def page(self) -> Path:
        """The report; of several sessions of drags, the first one."""
        several = f"{self.drags[0].header.session_id}/" if len(self.drags) > 1 else ""
        return self.folder / f"{several}report.html"

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        for drags in self.drags:
            yield from drag_summary(drags)
        if self.report is not None:
            yield from _summary(self.report)
        yield from self.notes
        yield f"Report: {self.folder / 'report.html'}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def validate(request: Request, progress: Progress = unseen) -> ValidationOutput:
    """Validate and write every file of the report; gates are checked by `check`.

    Raises `CalibrationError`, `ClusterError`, and what reading a recording raises. Finished work is kept in the folders
    of the sessions, so that the same command resumes.
    """
    for text in request.gates:
        tables.parse_gate(text)
    if request.tune_steps and not request.generators:
        raise CalibrationError("--tune", "needs a --generator to tune")
    curves = [read_curve(text) for text in request.curves]
    folder = _folder(request)
    check_writable(folder)
    existed = folder.exists()
    try:
        sessions = [open_session(p, folder / WORK, request.calibration, request.fit) for p in request.places]
        one_source(sessions)
        kind = _kind(sessions, request)
        extras = Extras()
        if kind == "press":
            extras = find_extras(sessions, request.loops, request.written, beside=request.beside)
    except BaseException:
        if not existed:
            _drop_empty(folder)
        raise
    if kind == "drag":
        return _drags(request, sessions, folder, progress)
    (folder / WORK).mkdir(parents=True, exist_ok=True)
    with _locked(folder), cluster(request.scheduler) if request.scheduler else threads(request.workers) as scheduler:
        outcome = validate_presses(sessions, request, scheduler, folder / WORK, progress)
        report, notes = _write(outcome, folder, request, curves, extras, progress)
        return ValidationOutput(folder, report, notes=(*extras.notes, *notes))


def check(output: ValidationOutput, request: Request) -> None:
    """Check the gates. Raises `GateMissed` if any is missed."""
    if request.gates and output.report is None:
        raise CalibrationError("--gate", "applies to presses; these are drags")
    if output.report is not None:
        tables.check_gates(output.report, [tables.parse_gate(text) for text in request.gates])


def _summary(report: Report) -> Iterator[object]:
    """Yield tables and lines for the terminal."""
    names = ", ".join(session.session_id for session in report.sessions[:4])
    yield f"{names}: {source_note(report.source)}"
    yield findings.measured(report)
    yield from tables.terminal_tables(report)
    yield from findings.findings(report)
    for point in findings.trust(report):
        yield f"{'•' if point.good is None else '✓' if point.good else '✗'} {point.text}"
    for one in report.refused[:MAX_REFUSED]:
        yield f"not used: {one.session_id} {one.stroke_id}: {one.why}"
    if len(report.refused) > MAX_REFUSED:
        yield f"and {len(report.refused) - MAX_REFUSED} more, in the report"


def _drop_empty(folder: Path) -> None:
    """Remove folders that hold no file; verified downloads stay."""
    for path in sorted([folder, *folder.rglob("*")], reverse=True):
        if path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _kind(sessions: Sequence[FittedSession], request: Request) -> str:
    """Kind of the strokes, `press` or `drag`."""
    kinds = {session.kind for session in sessions}
    if len(kinds) > 1:
        raise CalibrationError(str(sessions[-1].recording.path), "mixes presses and drags: validate them separately")
    [kind] = kinds
    for option, paths in (("--loop", request.loops), ("--written", request.written)):
        if paths and kind == "drag":
            raise CalibrationError(option, "is for a report of presses; these are drags")
    return kind


def _write(
    outcome: Outcome, folder: Path, request: Request, curves: Sequence[Curve], extras: Extras, progress: Progress
) -> tuple[Report, tuple[str, ...]]:
    """Write the files of a report; returns it, and notes on what was not written."""
    what, parts = "parts of the report made", 3
    progress(what, 0, parts)
    digest = tables.write_csv(outcome.scores, folder / SCORES)
    notes: list[str] = []
    beside = [SCORES]
    if request.parquet is not False:
        try:
            label = source_label(outcome.sessions[0].header.source, (s.header.brush for s in outcome.sessions))
            tables.write_parquet(outcome.scores, label, folder / PARQUET)
            beside.append(PARQUET)
        except CalibrationError as error:
            if request.parquet:
                raise
            notes.append(f"no scores.parquet: {error.what}")
    progress(what, 1, parts)
    report = report_of(outcome, request.command, digest, extras)
    progress(what, 2, parts)
    files = {"summary.csv": tables.summary_csv(report)}
    if report.written:
        files[TABLE_3] = tables.table_3_csv(report)
    else:
        (folder / TABLE_3).unlink(missing_ok=True)  # left by an earlier run with characters
    files["failures.csv"] = csv_text(Refused._fields, report.refused)
    pages = list(pages_beside(outcome.sessions, folder))
    beside += [*files, "report.json"]
    files["report.html"] = page_of(outcome, report, curves, beside, extras.figures, pages)
    files["report.json"] = report.to_json()
    write_files(folder, files)
    progress(what, parts, parts)
    return report, tuple(notes)


def _drags(request: Request, sessions: Sequence[FittedSession], folder: Path, progress: Progress) -> ValidationOutput:
    validated: list[DragValidation] = []
    for session in sessions:
        what = f"{session.header.session_id}: measured"
        captures = counted(session.recording.captures(), what, len(session.strokes), progress)
        results = measure_drags(captures, Params.of(session.calibration))
        predictions = None
        if request.fit is not None:
            predictions = predict_session(session.recording.path, request.fit, request.calibration, progress)
        validation = DragValidation(session.header, session.recording.path, session.sha256, results, predictions)
        target = folder / session.header.session_id if len(sessions) > 1 else folder
        write_drags(validation, target, request.command)
        validated.append(validation)
    return ValidationOutput(folder, drags=tuple(validated))


def _folder(request: Request) -> Path:
    if request.out is not None:
        return request.out
    if len(request.places) == 1 and not URL.match(request.places[0]):
        path = Path(request.places[0])
        return (path if path.is_dir() else path.parent) / FOLDER
    return Path(FOLDER)


@contextmanager
def _locked(folder: Path) -> Generator[None]:
    try:
        with FileLock(folder / WORK / "lock", timeout=0):
            yield
    except Timeout:
        raise CalibrationError(str(folder), "another validation is writing there") from None
