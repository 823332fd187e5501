"""Finds the finished session of a protocol: how a chain of commands knows what it has done already."""

from __future__ import annotations

from pathlib import Path

from collect.protocols.loading import load_protocol
from sessions.errors import SessionError
from sessions.reader import Recording


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
