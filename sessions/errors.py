"""Errors of the store, each with the path it is about.

SessionError
 +-- InputError          a file from elsewhere cannot be used as it is; nothing was written
 +-- SessionLocked       another process has the session open
 +-- SessionDamaged      what is on disk does not agree with the journal
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar


class SessionError(Exception):
    """Something about a session on disk; `path` says which file or folder."""

    exit_code: ClassVar[int] = 4

    def __init__(self, path: Path | str, what: str) -> None:
        self.path = Path(path)
        self.what = what
        super().__init__(f"{path}: {what}")


class InputError(SessionError):
    """A file given by the user cannot be used; says which field and what is allowed."""

    exit_code: ClassVar[int] = 2


class SessionLocked(SessionError):
    """Another process is writing this session."""

    exit_code: ClassVar[int] = 2


class SessionDamaged(SessionError):
    """The files and the journal disagree; nothing is thrown away, and nothing is guessed."""


def in_one_line(error: BaseException) -> str:
    """What a library or the system says went wrong, fit for the one line that a user sees."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
