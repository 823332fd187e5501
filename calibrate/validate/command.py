"""`brushloop validate`: from the locations of sessions to the files of a report."""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.drags.captures import measure_drags
from brushloop.calibrate.drags.report import DragValidation, predict_session, write_drags
from brushloop.calibrate.drags.report import summary as drag_summary
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.fit.brush import FOLDER as FITS
from brushloop.calibrate.fit.brush import BrushFit
from brushloop.calibrate.loop.compare import FILE as LOOP_FILE
from brushloop.calibrate.loop.compare import LoopRecord, read_loop
from brushloop.calibrate.pool import cluster, threads
from brushloop.calibrate.remote import URL, local_path
from brushloop.calibrate.report import framed, png_uri, source_note, write_files
from brushloop.calibrate.session import open_session as open_recording
from brushloop.calibrate.stroke.params import Params
from brushloop.calibrate.validate import findings, tables
from brushloop.calibrate.validate.models import FittedSession
from brushloop.calibrate.validate.page import Curve, page_of, pages_beside, read_curve
from brushloop.calibrate.validate.report import Report, report_of
from brushloop.calibrate.validate.run import Options, Outcome, Refused, validate_presses
from brushloop.calibrate.writing.scores import FILE as WRITTEN_FILE
from brushloop.calibrate.writing.scores import PICTURE, WrittenRecord, read_written
from brushloop.sessions.disk import check_writable, csv_text
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.records import Source
from brushloop.sessions.terminal import Progress, counted, unseen

FOLDER = "validation"
WORK = "work"
SCORES, PARQUET, TABLE_3 = "scores.csv", "scores.parquet", "table3.csv"
LOOP_FOLDER, WRITTEN_FOLDER = "loop", "written"
"""Default output folders of those commands: in the session, and next to the folder of sessions."""
MAX_PICTURE_BYTES = 16 * 1024 * 1024
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
    """What was left out or not written, and why."""

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


@dataclass(slots=True)
class Extras:
    """The loops and characters that go into a report, each once."""

    loops: dict[str, LoopRecord] = field(default_factory=dict[str, LoopRecord])
    written: dict[str, tuple[WrittenRecord, str]] = field(default_factory=dict[str, tuple[WrittenRecord, str]])
    """By digest, with Figure 13 as a data URI; empty if the picture is missing."""
    notes: list[str] = field(default_factory=list[str])
    """What was found and left out, or is missing, and why."""


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
    sessions = [open_session(place, request.calibration, request.fit) for place in request.places]
    one_source(sessions)
    if _kind(sessions, request) == "drag":
        return _drags(request, sessions, folder, progress)
    extras = find_extras(sessions, request.loops, request.written, beside=request.beside)
    (folder / WORK).mkdir(parents=True, exist_ok=True)
    with _locked(folder), cluster(request.scheduler) if request.scheduler else threads(request.workers) as scheduler:
        outcome = validate_presses(sessions, request, scheduler, folder / WORK, progress)
        return _write(outcome, folder, request, curves, extras)


def check(output: ValidationOutput, request: Request) -> None:
    """Check the gates. Raises `GateMissed` if any is missed."""
    if request.gates and output.report is None:
        raise CalibrationError("--gate", "applies to presses; these are drags")
    if output.report is not None:
        tables.check_gates(output.report, [tables.parse_gate(text) for text in request.gates])


def open_session(place: str, calibration: Path | None, fit: Path | None) -> FittedSession:
    """Open a session by path or URL. Raises `CalibrationError`, `InputError` or `SessionDamaged`, each naming it."""
    session = open_recording(local_path(place), calibration)
    path = session.recording.path
    closed = replay(path.parent / JOURNAL_NAME).closed if (path.parent / JOURNAL_NAME).is_file() else None
    if closed is not None and closed.sha256 != session.sha256:
        raise SessionDamaged(path, "is not the file that the session was closed with: its SHA-256 differs")
    if len({stroke.kind for stroke in session.strokes}) > 1:
        raise CalibrationError(str(path), "mixes presses and drags; validate them as two sessions")
    # A fit of drags is read with the strokes that it predicts.
    used = None if session.strokes[0].kind == "drag" else fit or current(path.parent, FITS)
    return FittedSession.of(session, None if used is None else load_artefact(used, BrushFit))


def one_source(sessions: Sequence[FittedSession]) -> Source:
    """Kind of ink of all recordings. Raises `CalibrationError` if they differ."""
    first = sessions[0]
    for other in sessions[1:]:
        if other.header.source != first.header.source:
            what = f"is {other.header.source}, {first.recording.path.name} is {first.header.source}"
            raise CalibrationError(str(other.recording.path), f"{what}: validate them separately")
    return first.header.source


def find_extras(
    sessions: Sequence[FittedSession], loops: Sequence[Path], written: Sequence[Path], *, beside: bool
) -> Extras:
    """Read the loops and characters named; of a kind without any, those beside the sessions if `beside` is true.

    Raises `CalibrationError` that names an unusable file.
    """
    extras = Extras()
    folders = [session.recording.path.resolve().parent for session in sessions]
    places = [session.recording.path.parent / LOOP_FOLDER for session in sessions] if beside else []
    for path in _files(loops, places, LOOP_FILE):
        with _naming_no_beside(requested=bool(loops)):
            loop = read_loop(path)
            _check_loop(path, loop, sessions)
        extras.loops[loop.digest] = loop
    places = [place / WRITTEN_FOLDER for folder in folders for place in (folder, folder.parent.parent) if beside]
    for path in _files(written, places, WRITTEN_FILE):
        with _naming_no_beside(requested=bool(written)):
            record = read_written(path)
            if not written and path.parent.parent not in folders and (why := _foreign(record, sessions, folders)):
                extras.notes.append(f"{path} is left out: {why}; --written uses it")
                continue
            _check_source(path, record.source, sessions)
            picture = path.parent / PICTURE
            if not picture.exists():
                extras.notes.append(f"{picture} does not exist: the report has no Figure 13 of {record.session}")
            extras.written[record.digest] = record, figure_13(picture, record) if picture.exists() else ""
    return extras


def figure_13(path: Path, record: WrittenRecord) -> str:
    """Figure 13 as a data URI. Raises `CalibrationError` unless it is the picture written with the record."""
    data = read_bounded(path, MAX_PICTURE_BYTES)
    if hashlib.sha256(data).hexdigest() != record.figure_13_sha256:
        raise CalibrationError(str(path), f"is not the picture of {WRITTEN_FILE} beside it: its SHA-256 differs")
    return png_uri(data)


def _files(named: Sequence[Path], places: Sequence[Path], name: str) -> list[Path]:
    """The files named, by themselves or by their folder; without any, those of that name in these places, each once."""
    if named:
        return [path / name if path.is_dir() else path for path in named]
    return [path for path in dict.fromkeys(place / name for place in places) if path.is_file()]


def _foreign(record: WrittenRecord, sessions: Sequence[FittedSession], folders: Sequence[Path]) -> str:
    """Explain why characters found near the sessions do not belong to them; empty if they do."""
    source = one_source(sessions)
    if record.source != source:
        return f"it is of {record.source}, not {source}"
    named = record.session not in ("", ".", "..") and Path(record.session).name == record.session
    if not named or not any((folder.parent / record.session).is_dir() for folder in folders):
        return f"its session {record.session} is not beside it"
    brushes = {session.header.brush for session in sessions}
    return "" if brushes == {record.brush} else f"it was written with another brush, {record.brush or 'not named'}"


def _check_loop(path: Path, record: LoopRecord, sessions: Sequence[FittedSession]) -> None:
    _check_source(path, record.source, sessions)
    if record.original_sha256 in {session.sha256 for session in sessions}:
        return
    names = [session.header.session_id for session in sessions]
    if record.original in names:
        why = f"is of another recording of {record.original}: its SHA-256 differs; `{record.MADE_BY}` compares again"
        raise CalibrationError(str(path), why)
    raise CalibrationError(str(path), f"repeats {record.original}, not {', '.join(names)}")


def _check_source(path: Path, source: Source, sessions: Sequence[FittedSession]) -> None:
    here, recording = one_source(sessions), sessions[0].recording.path.name
    if source != here:
        raise CalibrationError(str(path), f"is of {source}, {recording} of {here}: one report cannot hold both")


@contextmanager
def _naming_no_beside(*, requested: bool) -> Generator[None]:
    """Add a hint at --no-beside to an error about a file that was found, not requested."""
    try:
        yield
    except CalibrationError as error:
        if not requested:
            error.add_note("(found beside the session; --no-beside ignores it)")
        raise


def _summary(report: Report) -> Iterator[object]:
    """Yield tables and lines for the terminal."""
    names = ", ".join(session.session_id for session in report.sessions[:4])
    yield f"{names}: {source_note(report.source)}"
    yield findings.measured(report)
    yield from tables.terminal_tables(report)
    yield from findings.findings(report)
    for point in findings.trust(report):
        yield f"{'•' if point.good is None else '✓' if point.good else '✗'} {point.text}"
    for press in report.refused[:MAX_REFUSED]:
        yield f"not used: {press.session_id} {press.stroke_id}: {press.why}"
    if len(report.refused) > MAX_REFUSED:
        yield f"and {len(report.refused) - MAX_REFUSED} more, in the report"


def _kind(sessions: Sequence[FittedSession], request: Request) -> str:
    """Kind of the strokes, `press` or `drag`."""
    kinds = {session.strokes[0].kind for session in sessions}
    if len(kinds) > 1:
        raise CalibrationError(str(sessions[-1].recording.path), "mixes presses and drags: validate them separately")
    [kind] = kinds
    for option, paths in (("--loop", request.loops), ("--written", request.written)):
        if paths and kind == "drag":
            raise CalibrationError(option, "is for a report of presses; these are drags")
    return kind


def _write(
    outcome: Outcome, folder: Path, request: Request, curves: Sequence[Curve], extras: Extras
) -> ValidationOutput:
    """Write the files of a report, with notes on what was not written."""
    notes = extras.notes
    digest = tables.write_csv(outcome.scores, folder / SCORES)
    report = report_of(outcome, request.command, digest, extras.loops.values(), [w for w, _ in extras.written.values()])
    beside = [SCORES]
    if request.parquet is not False:
        try:
            tables.write_parquet(outcome.scores, report.label, folder / PARQUET)
            beside.append(PARQUET)
        except CalibrationError as error:
            if request.parquet:
                raise
            notes.append(f"no scores.parquet: {error.what}")
    files = {"summary.csv": tables.summary_csv(report)}
    if report.written:
        files[TABLE_3] = tables.table_3_csv(report)
    else:
        (folder / TABLE_3).unlink(missing_ok=True)  # left by an earlier run with characters
    files["failures.csv"] = csv_text(Refused._fields, report.refused)
    beside += [*files, "report.json"]
    figures_13 = [picture for _, picture in extras.written.values()]
    files["report.html"] = page_of(
        outcome, report, curves, beside, figures_13, list(pages_beside(outcome.sessions, folder))
    )
    files["report.json"] = report.to_json()
    write_files(folder, files)
    return ValidationOutput(folder, report, notes=tuple(notes))


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
