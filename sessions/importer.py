"""Photographs from elsewhere become a session: a folder of images and a table of what was commanded.

Everything is read and checked before anything is written; a refused import leaves nothing behind.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sessions.errors import InputError, SessionDamaged, in_one_line
from sessions.journal import fsync_folder
from sessions.messages import MAX_IMAGE_BYTES, PNG_START, decode_gray, image_message
from sessions.schemas import Header, Source, Topic
from sessions.store import SESSION_ID
from sessions.table import Row, read_table
from sessions.writer import Outgoing, SegmentWriter

QUEUE_LIMIT = 16
"""Photographs that wait for the disk: an import can slow down, so it need not hold a folder in memory."""
WAIT_S = 60.0


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """What the table cannot say."""

    kind: str = "drag"
    """`press` for vertical presses, `drag` for strokes with travel along the paper."""
    px_per_mm: float | None = None
    """Scale for tables without px_per_mm columns."""
    licence: str = ""
    origin: str = ""
    brush: str = ""


def import_photographs(
    folder: Path, table: Path, out: Path, options: ImportOptions, software: str, now_ns: Callable[[], int]
) -> Path:
    """Import into the session folder `out` (new); returns its MCAP file. Raises `InputError`, then nothing is left."""
    if not folder.is_dir():
        raise InputError(folder, "is not a folder of photographs")
    if out.exists():
        raise InputError(out, "exists already; recordings are never overwritten")
    if not SESSION_ID.fullmatch(out.name):
        raise InputError(out, "a session's name is letters, digits, '.', '_' and '-', at most 100 of them")
    if options.kind not in ("press", "drag"):
        raise InputError(table, f"--kind is {options.kind!r}, allowed: press, drag")
    rows = read_table(folder, table, "press" if options.kind == "press" else "drag", options.px_per_mm)
    digests = [_check_image(row.image) for row in rows]
    header = Header(
        session_id=out.name,
        source=Source.IMPORT,
        software=software,
        brush=options.brush,
        protocol=f"import of {len(rows)} {options.kind} strokes",
        licence=options.licence,
        origin=options.origin or f"{folder.resolve().name}, {table.name}",
    )
    stage = out.with_name(f".{out.name}.partial")
    try:
        shutil.rmtree(stage, ignore_errors=True)  # left by an import that was killed: a copy, nothing recorded
        stage.mkdir(parents=True)
        _write(rows, digests, stage / f"{out.name}.mcap", header, now_ns)
        stage.rename(out)
        fsync_folder(out.parent)
    except OSError as error:
        shutil.rmtree(stage, ignore_errors=True)
        raise InputError(out, f"cannot write: {in_one_line(error)}") from error
    except BaseException:
        shutil.rmtree(stage, ignore_errors=True)
        raise
    return out / f"{out.name}.mcap"


def _write(rows: list[Row], digests: list[bytes], final: Path, header: Header, now_ns: Callable[[], int]) -> None:
    writer = SegmentWriter(final, header, QUEUE_LIMIT)
    try:
        for index, (row, digest) in enumerate(zip(rows, digests, strict=True)):
            data = _read_bytes(row.image)
            if hashlib.sha256(data).digest() != digest:
                raise InputError(row.image, "changed while it was imported")
            t_ns = now_ns()
            kind = "png" if data.startswith(PNG_START) else "jpeg"
            writer.write(Outgoing(Topic.STILL, t_ns, t_ns, index, image_message(t_ns, data, kind)), WAIT_S)
            writer.write(Outgoing(Topic.STROKE, t_ns, t_ns, index, row.stroke), WAIT_S)
    except BaseException:
        writer.abandon()
        raise
    writer.finish()


def _check_image(path: Path) -> bytes:
    """Decode it once; the digest lets it be read again without decoding. Raises `InputError`."""
    data = _read_bytes(path)
    try:
        decode_gray(data, str(path))
    except SessionDamaged as error:
        raise InputError(path, error.what) from None
    return hashlib.sha256(data).digest()


def _read_bytes(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > MAX_IMAGE_BYTES:
            raise InputError(path, f"image of {size} bytes exceeds {MAX_IMAGE_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot read: {in_one_line(error)}") from None
