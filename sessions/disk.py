"""Files: safe names, disk space, durable writes, ways to place a file without losing another, and cells of CSV files.

The folder of a session received from elsewhere may contain links in place of files: `check_folder` checks it first. A
text that a spreadsheet would run as a formula is written into a CSV file with an apostrophe before it.
"""

from __future__ import annotations

import csv
import filecmp
import hashlib
import io
import itertools
import math
import os
import re
import shutil
import stat
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from brushloop.sessions.errors import DiskFull, InputError, SessionDamaged, SessionError, disk_error, in_one_line

MAX_TEXT_BYTES = 1024 * 1024
"""Largest file that people or this software write for people: a table, an artefact."""
SPARE_BYTES = 16 * 1024 * 1024
"""Space that is always kept free, so that the journal's last lines fit."""
MAX_SNAPSHOT_BYTES = 64 * 1024 * 1024
"""Limit of a file of a session that holds its configuration, with the rows of its tables."""
SESSION_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,99}")
SEGMENT_NAME = re.compile(r"(\d{4,})-([a-z_]+)-([0-9A-Za-z_.-]+?)\.mcap(\.part)?")
"""File of a step: serial, kind, start of the key, and `.part` while unfinished."""
SNAPSHOT_NAMES = ("rig.toml", "protocol.toml", "rig.effective.json")
NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
FORMULA_START = re.compile(r"'*[=+\-@\t\r\n＝＋－＠]")
"""Text that a spreadsheet runs, also where apostrophes precede it."""
COMPANIONS = ("journal.jsonl", "remarks.jsonl", "calibration", "brushfit", "dragfit", "validation", "loop", "written")
"""Files and folders that belong to a recording whose folder may also hold unrelated files."""


def check_room(folder: Path, need_bytes: int) -> None:
    """Raise `DiskFull` unless `need_bytes` plus `SPARE_BYTES` are free for this user on the disk of `folder`."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise SessionError(folder, f"cannot be read: {in_one_line(error)}") from error
    if free < need_bytes + SPARE_BYTES:
        need_mb, free_mb = (need_bytes + SPARE_BYTES) / 1e6, free / 1e6
        raise DiskFull(folder, f"the disk has {free_mb:.0f} MB left, {need_mb:.0f} MB are needed; make room")


def read_bounded(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Bytes of a file from a person or from elsewhere. Raises `InputError` where it is larger or cannot be read.

    At most `max_bytes` + 1 are read, even where the file grows meanwhile.
    """
    try:
        if not path.is_file() and path.exists():
            raise InputError(path, "is not a file")
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except OSError as error:
        raise InputError(path, f"cannot read: {in_one_line(error)}") from None
    if len(data) > max_bytes:
        raise InputError(path, f"is larger than {max_bytes} bytes")
    return data


def holds(path: Path, data: bytes) -> bool:
    """Whether a file is there and holds exactly these bytes. Raises `InputError` where it cannot be read."""
    return path.is_file() and path.stat().st_size == len(data) and read_bounded(path, len(data)) == data


def sync(file: IO[Any]) -> None:
    """Wait until what was written to an open file is on disk. Raises `OSError`."""
    file.flush()
    os.fsync(file.fileno())


def fsync_folder(folder: Path) -> None:
    """Make a rename or a new file in `folder`, or the content of a file, durable."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def write_durably(path: Path, data: bytes) -> None:
    """Write a new file and wait until it is on disk. Raises `OSError`."""
    with path.open("xb") as file:
        file.write(data)
        sync(file)


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """Give a temporary file to write to, which then becomes `path`: a reader sees the old file or the new one.

    The temporary file is removed on failure.
    """
    part = path.with_name(path.name + ".part")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        if error.errno is not None and not error.filename:
            error.filename = str(path)  # a full disk does not say which file it had no room for
        raise
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def staged_folder(out: Path) -> Generator[Path]:
    """Yield a folder beside `out` to write into; it is renamed to `out` at the end, and removed after an exception.

    An existing `out` is replaced only if it is an empty folder. Raises `OSError`.
    """
    stage = out.with_name(f".{out.name}.partial")
    missing = [parent for parent in out.parents if not parent.exists()]
    try:
        shutil.rmtree(stage, ignore_errors=True)  # left by a killed process: only a copy
        stage.mkdir(parents=True)
        yield stage
        for path in (*stage.rglob("*"), stage):
            fsync_folder(path)
        stage.rename(out)
        fsync_folder(out.parent)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        with suppress(OSError):  # after a success they are not empty
            for parent in missing:
                parent.rmdir()


def set_aside(path: Path, tag: str) -> Path:
    """Keep a copy of the file under a second name in its folder (`x.mcap.damaged-1`), and return that name.

    A file with the same content gets the same name again. Raises `SessionError` where the disk fails.
    """
    try:
        for number in itertools.count(1):
            kept = path.with_name(f"{path.name}.{tag}-{number}")
            if kept.exists() and filecmp.cmp(path, kept, shallow=False):
                return kept
            if not kept.exists():
                with path.open("rb") as source, kept.open("xb") as target:
                    shutil.copyfileobj(source, target)
                    sync(target)
                return kept
    except OSError as error:
        raise disk_error(path, "cannot keep a copy", error) from error
    raise AssertionError


def check_writable(folder: Path) -> None:
    """Raise `InputError` unless the folder can be written to, or created."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise InputError(there, "is a file; a folder is needed")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(there, "may not be written: it is read-only, or another user's")


def file_sha256(path: Path) -> str:
    """Hex digest of a file, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_digest(path: Path, sha256: str) -> None:
    """Raise `SessionDamaged` unless the file is byte for byte what was recorded."""
    if not path.is_file():
        raise SessionDamaged(path, "is missing, though the journal says it was finished")
    try:
        digest = file_sha256(path)
    except OSError as error:
        raise SessionDamaged(path, f"cannot read: {in_one_line(error)}") from None
    if digest != sha256:
        raise SessionDamaged(path, "has changed since it was recorded (sha256 differs from the journal)")


def check_folder(folder: Path) -> None:
    """Raise `InputError` where anything in a session's folder is a link, a device or a pipe, or cannot be read.

    The folder itself may be given by the user through a link.
    """

    def refuse(error: OSError) -> None:
        raise InputError(error.filename, f"cannot be read: {in_one_line(error)}") from None

    for inside, folders, files in os.walk(folder, onerror=refuse):
        for name in (*folders, *files):
            check_file(Path(inside, name))


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
    if stat.S_ISLNK(mode):
        raise InputError(path, "is a link, which is not allowed in a session's folder: put the file itself there")
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise InputError(path, "is neither a file nor a folder; a session's folder may hold nothing else")
    return True


def csv_text(head: Sequence[str], rows: Iterable[Iterable[object]], end: str = "\n") -> str:
    """A table as CSV, whose cells may hold untrusted text."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator=end)  # noqa: TID251 - the one place
    table.writerow(map(as_cell, head))
    table.writerows(map(as_cell, row) for row in rows)
    return out.getvalue()


def as_cell(value: object) -> object:
    """Cell for a value: numbers, also as text (`-0.5`), are unchanged; other text is never a formula."""
    formula = isinstance(value, str) and FORMULA_START.match(value) and not NUMBER.fullmatch(value)
    return f"'{value}" if formula else value


def as_text(cell: str) -> str:
    """Undo `as_cell`."""
    return cell[1:] if cell.startswith("'") and FORMULA_START.match(cell) else cell


def number(text: str) -> float:
    """The finite number in a cell, an option or an answer: `10`, `-0.5`, `1e3`. Raises ValueError.

    `1_0`, which Python reads as 10, is not one: in a table it is a typing error.
    """
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text[:80]!r} is not a finite number")
    return value
