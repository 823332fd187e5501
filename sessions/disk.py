"""Room on the disk, and ways to put a file somewhere without ever losing the one that is there."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

from sessions.errors import DiskFull, SessionError, disk_error, in_one_line

SPARE_BYTES = 16 * 1024 * 1024
"""What stays free whatever is written: the journal must have its last word."""
_PIECE_BYTES = 1 << 20


def free_bytes(folder: Path) -> int:
    """Room left for this user on the disk of `folder`. Raises `SessionError`."""
    try:
        return shutil.disk_usage(folder).free
    except OSError as error:
        raise SessionError(folder, f"cannot be looked at: {in_one_line(error)}") from error


def check_room(folder: Path, need_bytes: int) -> None:
    """Raise `DiskFull` unless so much, and a little to spare, is free."""
    free = free_bytes(folder)
    if free < need_bytes + SPARE_BYTES:
        need_mb, free_mb = (need_bytes + SPARE_BYTES) / 1e6, free / 1e6
        raise DiskFull(folder, f"the disk has {free_mb:.0f} MB left, {need_mb:.0f} MB are needed; make room", free)


def set_aside(path: Path, tag: str) -> Path:
    """Give the file a second name beside it (`x.mcap.damaged-1`) and keep the first; returns the second.

    Done again for the same bytes, it gives the same name. Raises `SessionError` where the disk fails.
    """
    try:
        for number in itertools.count(1):
            kept = path.with_name(f"{path.name}.{tag}-{number}")
            if not kept.exists():
                _link(path, kept)
                return kept
            if same_bytes(path, kept):
                return kept
    except OSError as error:
        raise disk_error(path, "cannot keep a copy", error) from error
    raise AssertionError


def same_bytes(one: Path, other: Path) -> bool:
    """Whether two files hold the same. Raises `OSError`."""
    if one.samefile(other):
        return True
    if one.stat().st_size != other.stat().st_size:
        return False
    with one.open("rb") as first, other.open("rb") as second:
        while piece := first.read(_PIECE_BYTES):
            if piece != second.read(_PIECE_BYTES):
                return False
    return True


def publish(part: Path, target: Path) -> None:
    """Give a finished file its name, which nobody may have yet. Raises `FileExistsError`, `OSError`."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if target.exists():
            raise FileExistsError(target) from None
        part.rename(target)
        return
    part.unlink()


def _link(path: Path, kept: Path) -> None:
    try:
        os.link(path, kept)
    except FileExistsError:
        raise
    except OSError:
        with path.open("rb") as source, kept.open("xb") as target:
            shutil.copyfileobj(source, target)
            target.flush()
            os.fsync(target.fileno())


def unwritable(folder: Path) -> tuple[Path, str] | None:
    """What stands in the way of writing into a folder, or of making it, and why; None where nothing does."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        return there, "is a file; a folder is needed"
    if not os.access(there, os.W_OK | os.X_OK):
        return there, "may not be written: it is read-only, or another user's"
    return None
