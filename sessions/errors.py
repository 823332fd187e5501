"""Errors about sessions on disk, each with the path of a file or folder."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import ClassVar


class SessionError(Exception):
    """Problem with a session on disk; `path` is the file or folder."""

    exit_code: ClassVar[int] = 4

    def __init__(self, path: Path | str, what: str) -> None:
        self.path = Path(path)
        self.what = what
        super().__init__(f"{path}: {what}")


class InputError(SessionError):
    """A file from elsewhere cannot be used as it is; the message names the field and what is allowed."""

    exit_code: ClassVar[int] = 2


class SessionLocked(SessionError):
    """Another process is writing this session."""

    exit_code: ClassVar[int] = 2


class SessionDamaged(SessionError):
    """The files and the journal disagree; nothing is discarded, and nothing is guessed."""

    exit_code: ClassVar[int] = 6


class DiskFull(SessionError):
    """No room for the next step. Finished steps stay, and the same command resumes."""


def disk_error(path: Path | str, what: str, error: BaseException) -> SessionError:
    """Make the error for a failed write: `DiskFull` where there was no room, `SessionError` otherwise."""
    message = f"{what}: {in_one_line(error)}"
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    return DiskFull(path, message) if full else SessionError(path, message)


def in_one_line(error: BaseException) -> str:
    """Error message of a library or the system, as one line for the user."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
