"""Finished sessions: what a person is told at the end of one, and which one a chain of commands has made already."""

from __future__ import annotations

from pathlib import Path

from collect.protocols.files import load_protocol
from sessions.errors import SessionError
from sessions.reader import Recording

PRESSES = frozenset({"grid", "adaptive", "list"})
"""Protocols whose recording is calibrated and validated by itself; of others, what comes next is not one command."""


def ending(folder: Path, kind: str) -> str:
    """Lines that say where the recording of a session lies, and the next command; `kind` is its protocol's."""
    lines = [f"recorded: {folder / folder.name}.mcap"]
    if kind in PRESSES:
        # On the screen it may have been calibrated already.
        command = "validate" if (folder / "calibration").is_dir() else "calibrate"
        lines.append(f"next:     brushloop {command} {folder}")
    return "".join(f"{line}\n" for line in lines)


def finished_session(root: Path, protocol: Path) -> Path | None:
    """The newest finished session of exactly this protocol under `root`. Raises `ConfigError` for a bad protocol."""
    told = load_protocol(protocol).model_dump_json()
    found: list[Path] = []
    for folder in root.iterdir() if root.is_dir() else ():
        try:
            if folder.is_dir() and Recording(folder).header.protocol == told:
                found.append(folder)
        except SessionError:
            continue  # open, damaged, or no session
    return max(found, key=lambda path: (path / f"{path.name}.mcap").stat().st_mtime_ns, default=None)
