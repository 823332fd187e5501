"""Stages that chains share: find or collect a finished session, calibrate it and fit its brush."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from brushloop.calibrate.artefact import artefacts
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.collect.start import CollectRequest, collect
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import show_work

Say = Callable[[str], None]
GIVEN_UP = 3
"""Exit code of a collection that finished but left strokes out."""


def finished_session(root: Path, config: Path, protocol: Path) -> Path | None:
    """The newest finished session under `root` of exactly this protocol with the brush, ink and paper of `config`.

    Raises `ConfigError` for a bad file.
    """
    if not root.is_dir():
        return None
    rig, wanted = load_rig(config), load_protocol(protocol).model_dump_json()
    material = (rig.brush.name, rig.ink.name, rig.paper.name)
    found: list[Path] = []
    for folder in root.iterdir():
        try:
            header = Recording(folder).header
            if header.protocol == wanted and (header.brush, header.ink, header.paper) == material:
                found.append(folder)
        except SessionError:
            continue  # open, damaged, or no session
    return max(found, key=lambda path: (path / f"{path.name}.mcap").stat().st_mtime_ns, default=None)


def collected(say: Say, request: CollectRequest) -> int:
    """Collect a session, or go on with it; return the exit code, `GIVEN_UP` if strokes were left out."""
    say(f"$ brushloop collect --config {request.config} --protocol {request.protocol} --out {request.out}")
    return GIVEN_UP if collect(request).given_up else 0


def collected_session(say: Say, request: CollectRequest) -> Path:
    """The finished and calibrated session that is asked for; collected and calibrated if missing.

    Raises `ConfigError` and what ended the collection.
    """
    wanted = request.out, request.config, request.protocol
    session = finished_session(*wanted)
    if session is None:
        collected(say, request)
        session = finished_session(*wanted)
    if session is None:
        raise ConfigError(
            request.out, "", f"holds no finished session of {request.protocol}, although collection ended"
        )
    calibrated(say, session)
    return session


def calibrated(say: Say, session: Path) -> None:
    """Calibrate a session that was not calibrated yet. Raises `CalibrationError`, `SessionError`."""
    from brushloop.calibrate.calibrated import CalibrateRequest, calibrate_session  # slow to import

    if not artefacts(session):
        say(f"calibrate {session}")
        show_work(calibrate_session, CalibrateRequest(session))


def fitted(say: Say, session: Path) -> None:
    """Fit the brush of a session that has no fit yet. Raises `CalibrationError`, `SessionError`."""
    from brushloop.calibrate.fit.brush import FOLDER, FitRequest, fit_presses  # slow to import

    if not artefacts(session, FOLDER):
        say(f"fit {session}")
        show_work(fit_presses, FitRequest(session))
