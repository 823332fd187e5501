"""One run of `brushloop collect`: read, check and open the session, then run behind a screen or a progress bar.

Commands that collect among other things look here for the finished session of a protocol, calibrate it and fit it.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from brushloop.calibrate.artefact import FITS, current
from brushloop.calibrate.commands import CalibrateRequest, FitRequest, show_work
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.control import FINAL
from brushloop.collect.engine.engine import Engine, engine_for
from brushloop.collect.engine.live import LiveView
from brushloop.collect.engine.open_or_resume import Opening
from brushloop.collect.engine.snapshot import REFRESH_S, Snapshot, eta_text, no_pose_text
from brushloop.collect.errors import StrokesLeftOut
from brushloop.collect.operator import stop_signals
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.collect.rig.config import load_rig
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import plain_console, say


def run(request: CollectRequest) -> None:
    """Do what `brushloop collect` asks. Raises the error that ended the run, and `StrokesLeftOut`.

    The recording of a dry run is thrown away, so that no patch counts as used.
    """
    if request.dry_run_mm is not None:
        with tempfile.TemporaryDirectory(prefix="brushloop-dry-") as folder:
            in_the_air = replace(_settled(request), out=Path(folder), new=False, sheet=None, guided=False)
            _run(Opening.load(in_the_air))
        say("dry run done; nothing was kept")
    elif left_out := collect(request).given_up:
        raise StrokesLeftOut(left_out)


def _settled(request: CollectRequest) -> CollectRequest:
    """The request with or without a screen: as asked for, else if there is a terminal."""
    screen = sys.stdin.isatty() and sys.stdout.isatty() if request.on_screen is None else request.on_screen
    return replace(request, on_screen=screen, guided=request.guided and screen)


def collect(request: CollectRequest, *, chained: bool = False) -> Snapshot:
    """Run to the end and print where the recording lies and what comes next; return how it ended.

    `chained`: a command continues after the run. Raises the error that ended the run.
    """
    opening = Opening.load(_settled(request))
    with contextlib.closing(LiveView(request.live_port)) if request.live else contextlib.nullcontext() as live:
        now = _run(replace(opening, live=live), chained=chained).snapshot()
    folder = Path(now.folder)
    say(f"recorded: {folder / folder.name}.mcap")
    if not chained and not isinstance(opening.protocol, WriteConfig):  # characters are analysed with their plan
        report = folder / "validation" / "report.html"
        say(f"report:   {report}" if report.exists() else f"next:     brushloop analyse {folder}")
    return now


def collect_session(
    config: Path, protocol: Path, out: Path = Path("sessions"), *, sheet: int | None = None, armed: bool = False
) -> Path:
    """Carry out a protocol without a screen, as `brushloop collect --no-tui` does; return the session's folder.

    `sheet` confirms that this sheet is in, `armed` lets real hardware move. An open session of the same files is
    resumed. Raises `ConfigError`, `CollectAborted`, `SessionError` and what the devices raise.
    """
    request = CollectRequest(Path(config), Path(protocol), Path(out), sheet=sheet, armed=armed, on_screen=False)
    return Path(collect(request).folder)


def _run(opening: Opening, *, chained: bool = False) -> Engine:
    """Run to the end; return the engine that ran last, as the operator may resume after a stop."""
    engine = engine_for(opening)
    if not opening.request.on_screen:
        run_headless(engine)
        return engine

    def again(session_id: str) -> Engine:
        return engine_for(replace(opening, request=replace(opening.request, new=False, resume=session_id)))

    from brushloop.collect.tui.app import ANALYSE, GO_ON, OperatorApp, run_app

    app = OperatorApp(again, engine)
    app.next = GO_ON if chained else ANALYSE
    run_app(app)
    return app.engine or engine


def run_headless(engine: Engine) -> None:
    """Run to the end; raise the error that ended the run. If the output goes away, the step ends and the arm parks."""
    with stop_signals(engine.obey):
        engine.start()
        try:
            # The terminal or pipe may be gone; rich turns a broken pipe into a SystemExit.
            with contextlib.suppress(OSError, SystemExit):
                show_progress(engine)
        finally:
            if not engine.finished:
                engine.park()
            engine.join()


def show_progress(engine: Engine) -> None:
    """Print the log and a progress bar until the run is over."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    shown, silent = 0, False
    described, to_go = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[eta]}")
    columns = described, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), to_go
    with Progress(*columns, console=plain_console(stderr=True)) as progress:
        task = progress.add_task("connect", total=None, eta="")
        while True:
            over = engine.finished
            now = engine.snapshot()
            for line in now.messages[shown:]:
                progress.console.print(line, highlight=False)
            shown = len(now.messages)
            if (now.no_pose_s is not None) is not silent:
                silent = now.no_pose_s is not None
                line = f"warning: {no_pose_text(now)}" if silent else "the arm sends its pose again"
                progress.console.print(line, highlight=False)
            doing = str(now.state) if now.state in FINAL else f"{now.state}: {now.step}"
            progress.update(
                task,
                description=", ".join(filter(None, (doing, no_pose_text(now)))),
                completed=now.strokes_done,
                total=now.strokes_planned,
                eta=eta_text(now),
            )
            if over:
                return
            time.sleep(REFRESH_S)


# Stages of commands that collect among other things


def finished_session(root: Path, config: Path, protocol: Path) -> Path | None:
    """The newest finished session under `root` of exactly this protocol with the brush, ink and paper of `config`.

    Raises `ConfigError` for a bad file.
    """
    if not root.is_dir():
        return None
    rig, wanted = load_rig(config), load_protocol(protocol).model_dump_json()
    material = (rig.brush.name, rig.ink.name, rig.paper.name)
    sessions: list[Path] = []
    for folder in root.iterdir():
        with contextlib.suppress(SessionError):  # open, damaged, or no session
            header = Recording(folder).header
            if (header.protocol, header.brush, header.ink, header.paper) == (wanted, *material):
                sessions.append(folder)
    return max(sessions, key=lambda path: (path / f"{path.name}.mcap").stat().st_mtime_ns, default=None)


def collected_session(request: CollectRequest) -> Path:
    """The finished and calibrated session that is asked for; collected and calibrated if missing.

    Raises `ConfigError` and what ended the collection.
    """
    session = finished_session(request.out, request.config, request.protocol)
    if session is None:
        say(f"$ brushloop collect --config {request.config} --protocol {request.protocol} --out {request.out}")
        session = Path(collect(request, chained=True).folder)
    calibrated(session)
    return session


def calibrated(session: Path) -> None:
    """Calibrate a session that was not calibrated yet. Raises `CalibrationError`, `SessionError`."""
    from brushloop.calibrate.calibrated import calibrate_session  # slow to import

    if current(session) is None:
        say(f"calibrate {session}")
        show_work(calibrate_session, CalibrateRequest(session))


def fitted(session: Path) -> Path:
    """The brush fit in use of a session, made if there is none. Raises `CalibrationError`, `SessionError`."""
    from brushloop.calibrate.fit.command import fit_press_session  # slow to import

    fit = current(session, FITS)
    if fit is None:
        say(f"fit {session}")
        fit = show_work(fit_press_session, FitRequest(session)).path
    return fit
