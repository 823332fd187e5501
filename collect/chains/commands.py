"""Stages that chains share: find or collect a finished session, calibrate it and fit its brush."""

from __future__ import annotations

from pathlib import Path

from brushloop.calibrate.artefact import current
from brushloop.calibrate.commands import CalibrateRequest, FitRequest, show_work
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.collect.start import Collected, CollectRequest, collect
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import say


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
        try:
            header = Recording(folder).header
            if header.protocol == wanted and (header.brush, header.ink, header.paper) == material:
                sessions.append(folder)
        except SessionError:
            continue  # open, damaged, or no session
    return max(sessions, key=lambda path: (path / f"{path.name}.mcap").stat().st_mtime_ns, default=None)


def collected(request: CollectRequest) -> Collected:
    """Collect a session, or go on with it. Raises `ConfigError` and what ended the collection."""
    say(f"$ brushloop collect --config {request.config} --protocol {request.protocol} --out {request.out}")
    return collect(request)


def collected_session(request: CollectRequest) -> Path:
    """The finished and calibrated session that is asked for; collected and calibrated if missing.

    Raises `ConfigError` and what ended the collection.
    """
    session = finished_session(request.out, request.config, request.protocol) or collected(request).folder
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
    from brushloop.calibrate.fit.fit import FOLDER, fit_presses  # slow to import

    fit = current(session, FOLDER)
    if fit is None:
        say(f"fit {session}")
        fit = show_work(fit_presses, FitRequest(session)).path
    return fit
