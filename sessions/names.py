"""Names of sessions and files, and checks that keep a session received from elsewhere within its own folder.

The journal of such a session may contain any name, and its folder may contain links in place of files. Every name
that is read from a session is checked by `bare_name`, and every folder by `check_folder`, before it is used.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from brushloop.sessions.errors import InputError, in_one_line

SESSION_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,99}")
SEGMENT_NAME = re.compile(r"(\d{4,})-([a-z_]+)-([0-9A-Za-z_.-]+?)\.mcap(\.part)?")
"""File of a step: serial, kind, start of the key, and `.part` while unfinished."""
SNAPSHOT_NAMES = ("rig.toml", "protocol.toml", "rig.effective.json")
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
"""Files and folders that belong to a recording whose folder may also hold unrelated files."""


def bare_name(value: object) -> str:
    """Return the name of a file in the session's folder. Raises `ValueError` for a name that could lead elsewhere."""
    if not isinstance(value, str):
        raise ValueError("is not a string")
    plain = value.isprintable() and "/" not in value and "\\" not in value
    if value in ("", ".", "..") or not plain or len(value.encode("utf-8", "replace")) > MAX_NAME_BYTES:
        raise ValueError(f"is {value[:60]!r}, allowed is the name of a file in the session's folder")
    return value


def check_folder(folder: Path) -> None:
    """Raise `InputError` where anything in a session's folder is a link, a device or a pipe.

    The folder itself may be given by the user through a link.
    """
    waiting = [folder]
    while waiting:
        inside = waiting.pop()
        try:
            with os.scandir(inside) as entries:
                found = [(Path(entry.path), entry.stat(follow_symlinks=False).st_mode) for entry in entries]
        except OSError as error:
            raise InputError(inside, f"cannot be read: {in_one_line(error)}") from None
        for path, mode in found:
            _check_mode(path, mode)
            if stat.S_ISDIR(mode):
                waiting.append(path)


def check_companions(folder: Path) -> None:
    """Like `check_folder`, but only for the `COMPANIONS` of a recording; unrelated files are not checked."""
    for name in COMPANIONS:
        path = folder / name
        if check_file(path) and path.is_dir():
            check_folder(path)


def check_file(path: Path) -> bool:
    """Whether the path exists. Raises `InputError` where it is a link, a device or a pipe."""
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
