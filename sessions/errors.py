"""Errors of the store, each with the path it is about.

SessionError
 +-- InputError          a file from elsewhere cannot be used as it is; nothing was written
 +-- SessionLocked       another process has the session open
 +-- SessionDamaged      what is on disk does not agree with the journal
 +-- DiskFull            no room for what comes next; what is finished stays, and the same command goes on
"""

from __future__ import annotations

import errno
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

    exit_code: ClassVar[int] = 6


class DiskFull(SessionError):
    """The disk has no room, or ran out of it. Nothing finished is lost; the attempt at hand was not finished."""

    def __init__(self, path: Path | str, what: str, free_bytes: int | None = None) -> None:
        self.free_bytes = free_bytes
        super().__init__(path, what)


def disk_error(path: Path | str, what: str, error: BaseException) -> SessionError:
    """What a failed write becomes: `DiskFull` where there was no room, `SessionError` otherwise."""
    told = f"{what}: {in_one_line(error)}"
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    return DiskFull(path, told) if full else SessionError(path, told)


def in_one_line(error: BaseException) -> str:
    """What a library or the system says went wrong, fit for the one line that a user sees."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
