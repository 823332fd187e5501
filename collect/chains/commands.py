"""Helpers for chains of commands: run another brushloop command, and find or make a finished session."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import Popen

from brushloop.calibrate.artefact import artefacts
from brushloop.collect.errors import ConfigError
from brushloop.collect.headless import stop_signals
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import say as print_lines
from brushloop.sessions.terminal import shown

Say = Callable[[str], None]
GIVEN_UP = 3
"""Exit code of a collection that finished but left strokes out."""
PRESSES = frozenset({"grid", "few-strokes", "list"})
"""Protocols whose recording can be calibrated and validated by itself; after others, no single next command exists."""


class CommandFailed(Exception):
    """A command ended with an exit code; it has printed why itself."""

    def __init__(self, words: list[str], code: int) -> None:
        self.words = words
        self.exit_code = code
        super().__init__(
            f"`brushloop {' '.join(words)}` ended with exit code {code}; the same command resumes from there"
        )


def run_command(say: Say, *arguments: str | Path, accepts: tuple[int, ...] = (0,)) -> int:
    """Run `brushloop ARGUMENTS` on this terminal, in a process of its own; return its exit code.

    SIGTERM and SIGHUP are passed on to it: a collection must not go on without the command that began it.
    Raises `CommandFailed` for a code that is not in `accepts`.
    """
    words = [str(argument) for argument in arguments]
    say(f"$ brushloop {' '.join(words)}")
    process = Popen([sys.executable, "-m", "brushloop", *words])
    with stop_signals(process.send_signal, (signal.SIGTERM, signal.SIGHUP)):
        while True:
            try:
                code = process.wait()
                break
            except KeyboardInterrupt:
                continue  # the command receives it too, stops the arm and reports it
    if code not in accepts:
        raise CommandFailed(words, code if code > 0 else 4)
    return code


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


def collected_session(say: Say, config: Path, protocol: Path, root: Path, options: Sequence[str | Path]) -> Path:
    """The finished and calibrated session of these files under `root`; collected and calibrated if missing.

    Raises `ConfigError`, `CommandFailed`.
    """
    session = finished_session(root, config, protocol)
    if session is None:
        files = ("--config", config, "--protocol", protocol, "--out", root)
        run_command(say, "collect", *files, *options, accepts=(0, GIVEN_UP))
        session = finished_session(root, config, protocol)
    if session is None:
        raise ConfigError(root, "", f"holds no finished session of {protocol}, although collection ended")
    calibrated(say, session)
    return session


def calibrated(say: Say, session: Path) -> None:
    """Calibrate a session that was not calibrated yet. Raises `CalibrationError`, `SessionError`."""
    from brushloop.calibrate.calibrated import calibrate_session  # slow to import

    if not artefacts(session):
        say(f"calibrate {session}")
        with shown() as progress:
            print_lines(*calibrate_session(session, progress=progress).lines())


def fitted(say: Say, session: Path) -> None:
    """Fit the brush of a session that has no fit yet. Raises `CalibrationError`, `SessionError`."""
    from brushloop.calibrate.fit.command import FOLDER, FitRequest, fit_presses  # slow to import

    if not artefacts(session, FOLDER):
        say(f"fit {session}")
        with shown() as progress:
            print_lines(*fit_presses(FitRequest(session), progress).lines())


def ending(folder: Path, kind: str) -> str:
    """Lines that name the recording of a finished session and the next command; `kind` is its protocol's kind."""
    lines = [f"recorded: {folder / folder.name}.mcap"]
    if kind in PRESSES:
        # It may have been calibrated on the screen already.
        command = "validate" if (folder / "calibration").is_dir() else "calibrate"
        lines.append(f"next:     brushloop {command} {folder}")
    return "".join(f"{line}\n" for line in lines)
