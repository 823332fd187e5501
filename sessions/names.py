"""What a folder that came from elsewhere may name: files of its own, and nothing else.

Whoever hands a session on may write any name into its journal, and may put links where files should be. Every name
that is read from a session goes through `bare_name`, and every folder through `check_folder`, before it is used.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sessions.errors import InputError, in_one_line

MAX_NAME_BYTES = 255
COMPANIONS = (
    "journal.jsonl",
    "remarks.jsonl",
    "calibration",
    "brushfit",
    "dragfit",
    "validation",
    "loop",
    "written",
)
"""What is read, or written, beside a recording that lies in a folder of other things."""


def bare_name(value: object) -> str:
    """The name of a file in the folder at hand. Raises `ValueError` for anything that could lead elsewhere."""
    if not isinstance(value, str):
        raise ValueError("is not a string")
    plain = value.isprintable() and not any(sign in value for sign in "/\\")
    if value in ("", ".", "..") or not plain or len(value.encode("utf-8", "replace")) > MAX_NAME_BYTES:
        raise ValueError(f"is {value[:60]!r}, allowed is the name of a file in the session's folder")
    return value


def check_folder(folder: Path) -> None:
    """Raise `InputError` where anything in a session's folder is a link, a device or a pipe.

    The folder itself may be given through a link: that is the choice of whoever gives it.
    """
    waiting = [folder]
    while waiting:
        inside = waiting.pop()
        try:
            with os.scandir(inside) as entries:
                found = [(Path(entry.path), entry.stat(follow_symlinks=False).st_mode) for entry in entries]
        except OSError as error:
            raise InputError(inside, f"cannot be looked at: {in_one_line(error)}") from None
        for path, mode in found:
            _check_mode(path, mode)
            if stat.S_ISDIR(mode):
                waiting.append(path)


def check_companions(folder: Path) -> None:
    """The same for what belongs to a single recording, in a folder that may hold anything else as well."""
    for name in COMPANIONS:
        path = folder / name
        if check_file(path) and path.is_dir():
            check_folder(path)


def check_file(path: Path) -> bool:
    """Whether there is something of this name. Raises `InputError` where that is a link, a device or a pipe."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return False
    _check_mode(path, mode)
    return True


def _check_mode(path: Path, mode: int) -> None:
    if stat.S_ISLNK(mode):
        raise InputError(path, "is a link, which nothing in a session's folder may be: put the file itself there")
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise InputError(path, "is neither a file nor a folder; nothing else may be in a session's folder")
