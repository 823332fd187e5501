"""`brushloop validate`: from the locations of sessions to the files of a report."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.drags.measure import validate_drags
from brushloop.calibrate.drags.predicted import predict_session
from brushloop.calibrate.drags.report import DragValidation, write_drags
from brushloop.calibrate.drags.report import summary as drag_summary
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import check_folder
from brushloop.calibrate.pool import cluster, threads
from brushloop.calibrate.report import framed, write_files
from brushloop.calibrate.stroke.params import Params
from brushloop.calibrate.validate.ablation import similarity_by_strokes
from brushloop.calibrate.validate.candidates import generator_file
from brushloop.calibrate.validate.extras import Extras, ExtrasRequest, find_extras
from brushloop.calibrate.validate.gates import check_gates, parse_gate
from brushloop.calibrate.validate.report.data import Report
from brushloop.calibrate.validate.report.figures import read_curve
from brushloop.calibrate.validate.report.outputs import summary, summary_csv, table_3_csv, write_csv, write_parquet
from brushloop.calibrate.validate.report.page import page_of, pages_beside
from brushloop.calibrate.validate.report.summary import report_of
from brushloop.calibrate.validate.run import Options, Outcome, validate_presses
from brushloop.calibrate.validate.sources import URL, LoadedSession, one_source, open_session
from brushloop.sessions.disk import csv_text
from brushloop.sessions.terminal import Progress, counted, unseen

FOLDER = "validation"
WORK = "work"
SCORES, PARQUET, TABLE_3 = "scores.csv", "scores.parquet", "table3.csv"


@dataclass(frozen=True, slots=True)
class Request:
    """What the command line asked for."""

    places: tuple[str, ...]
    command: str
    """Named by the report as what made it."""
    models: tuple[str, ...] = ()
    view: Field = field(default_factory=Field)
    calibration: Path | None = None
    fit: Path | None = None
    generators: tuple[Path, ...] = ()
    curves: tuple[str, ...] = ()
    gates: tuple[str, ...] = ()
    ablations: bool = False
    held_out: bool = True
    tune_steps: int = 0
    parquet: bool | None = None
    """None writes it if pyarrow is installed."""
    extras: ExtrasRequest = field(default_factory=ExtrasRequest)
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
            yield from summary(self.report)
        yield from self.notes
        yield f"Report: {self.folder / 'report.html'}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def validate(request: Request, progress: Progress = unseen) -> ValidationOutput:
    """Validate and write every file of the report; gates are checked by `check`.

    Raises `CalibrationError`, `ClusterError`, and what reading a recording raises. Finished work is kept in the
    folder's `work`, so that the same command resumes.
    """
    for text in request.gates:
        parse_gate(text)
    if request.tune_steps and not request.generators:
        raise CalibrationError("--tune", "needs a --generator to tune")
    curves = [read_curve(text) for text in request.curves]
    folder = _folder(request)
    check_folder(folder)
    existed = folder.exists()
    try:
        sessions = [open_session(p, folder / WORK, request.calibration, request.fit) for p in request.places]
        one_source(sessions)
        kind = _kind(sessions, request)
        extras = find_extras(sessions, request.extras) if kind == "press" else Extras()
    except BaseException:
        if not existed:
            _drop_empty(folder)
        raise
    if kind == "drag":
        return _drags(request, sessions, folder, progress)
    options = Options(
        request.models,
        request.view,
        tuple(generator_file(path) for path in request.generators),
        request.ablations,
        request.held_out,
        request.tune_steps,
    )
    (folder / WORK).mkdir(parents=True, exist_ok=True)
    with _locked(folder), cluster(request.scheduler) if request.scheduler else threads(request.workers) as scheduler:
        outcome = validate_presses(sessions, options, scheduler, folder / WORK, progress)
        with outcome.store:
            steps = similarity_by_strokes(outcome, scheduler, progress) if request.ablations else ()
            report, notes = _write(outcome, folder, request, steps, curves, extras, progress)
            return ValidationOutput(folder, report, notes=(*extras.notes, *notes))


def check(output: ValidationOutput, request: Request) -> None:
    """Check the gates. Raises `GateMissed` if any is missed."""
    if request.gates and output.report is None:
        raise CalibrationError("--gate", "applies to presses; these are drags")
    if output.report is not None:
        check_gates(output.report, [parse_gate(text) for text in request.gates])


def _drop_empty(folder: Path) -> None:
    """Remove folders that hold no file; verified downloads stay."""
    for path in sorted([folder, *folder.rglob("*")], reverse=True):
        if path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _kind(sessions: list[LoadedSession], request: Request) -> str:
    """Kind of the strokes, `press` or `drag`."""
    kinds = {kind for session in sessions for kind in session.kinds}
    if len(kinds) > 1:
        raise CalibrationError(str(sessions[-1].recording.path), "mixes presses and drags: validate them separately")
    [kind] = kinds
    for option, paths in (("--loop", request.extras.loops), ("--written", request.extras.written)):
        if paths and kind == "drag":
            raise CalibrationError(option, "is for a report of presses; these are drags")
    return kind


def _write(
    outcome: Outcome,
    folder: Path,
    request: Request,
    steps: tuple[Any, ...],
    curves: Sequence[Any],
    extras: Extras,
    progress: Progress,
) -> tuple[Report, tuple[str, ...]]:
    what, parts = "parts of the report made", 3
    progress(what, 0, parts)
    digest = write_csv(outcome, folder / SCORES)
    notes: list[str] = []
    beside = [SCORES]
    if request.parquet is not False:
        try:
            write_parquet(outcome, folder / PARQUET)
            beside.append(PARQUET)
        except CalibrationError as error:
            if request.parquet:
                raise
            notes.append(f"no scores.parquet: {error.what}")
    progress(what, 1, parts)
    report, extremes = report_of(outcome, request.command, digest, steps, extras)
    progress(what, 2, parts)
    files = {"summary.csv": summary_csv(report)}
    if report.written:
        files[TABLE_3] = table_3_csv(report)
    else:
        (folder / TABLE_3).unlink(missing_ok=True)  # left by an earlier run with characters
    refused = [(r.session_id, r.stroke_id, r.why) for r in report.refused]
    files["failures.csv"] = csv_text(("session_id", "stroke_id", "why"), refused)
    pages = list(pages_beside(outcome.sessions, folder))
    files["report.html"] = page_of(
        outcome, report, extremes, curves, [*beside, *files, "report.json"], extras.figures, pages
    )
    files["report.json"] = report.to_json()
    write_files(folder, files)
    progress(what, parts, parts)
    return report, tuple(notes)


def _drags(request: Request, sessions: list[LoadedSession], folder: Path, progress: Progress) -> ValidationOutput:
    validated: list[DragValidation] = []
    for one in sessions:
        captures = counted(one.recording.captures(), f"{one.header.session_id}: measured", one.count, progress)
        results = validate_drags(captures, Params.of(one.calibration))
        predictions = None
        if request.fit is not None:
            predictions = predict_session(one.recording.path, request.fit, request.calibration, progress)
        validation = DragValidation(one.header, one.recording.path, one.sha256, results, predictions)
        target = folder / one.header.session_id if len(sessions) > 1 else folder
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
    lock = FileLock(folder / WORK / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise CalibrationError(str(folder), "another validation is writing there") from None
    try:
        yield
    finally:
        lock.release()
