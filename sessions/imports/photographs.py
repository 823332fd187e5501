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
from sessions.imports.table import Row, read_table
from sessions.journal.journal import fsync_folder
from sessions.recording.messages import MAX_IMAGE_BYTES, PNG_START, decode_gray, image_message
from sessions.recording.schemas import Header, Source, Topic
from sessions.recording.writer import Outgoing, SegmentWriter
from sessions.store import SESSION_ID

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
    brush_radius_mm: float | None = None
    """R and L of the bundle, for the models of presses; None takes the nominal brush of the paper."""
    brush_length_mm: float | None = None


def import_photographs(
    folder: Path, table: Path, out: Path, options: ImportOptions, software: str, now_ns: Callable[[], int]
) -> Path:
    """Import into the session folder `out` (new); returns its MCAP file. Raises `InputError`, then nothing is left."""
    check_target(folder, table, out, options)
    rows = read_table(folder, table, "press" if options.kind == "press" else "drag", options.px_per_mm)
    protocol = f"import of {len(rows)} {options.kind} strokes"
    return store_rows(rows, folder, table, out, options, protocol, software, now_ns)


def check_target(folder: Path, table: Path, out: Path, options: ImportOptions) -> None:
    """Raises `InputError` for a folder, a target or a kind that cannot be."""
    if not folder.is_dir():
        raise InputError(folder, "is not a folder of photographs")
    if out.exists():
        raise InputError(out, "exists already; recordings are never overwritten")
    if not SESSION_ID.fullmatch(out.name):
        raise InputError(out, "a session's name is letters, digits, '.', '_' and '-', at most 100 of them")
    if options.kind not in ("press", "drag"):
        raise InputError(table, f"--kind is {options.kind!r}, allowed: press, drag")


def store_rows(
    rows: list[Row],
    folder: Path,
    table: Path,
    out: Path,
    options: ImportOptions,
    protocol: str,
    software: str,
    now_ns: Callable[[], int],
    *,
    opening: Path | None = None,
    encoded: Callable[[Row], bytes] | None = None,
) -> Path:
    """Write strokes with their photographs into the session folder `out`; returns its MCAP file.

    `opening` is a photograph without a stroke that comes first. `encoded` gives a stroke's PNG or JPEG, its file as it
    is when left out. Raises `InputError`, then nothing is left.
    """
    encoded = encoded or _whole
    digests = [_check(encoded(row), row.image) for row in rows]
    first = None if opening is None else read_bounded(opening)
    if first is not None and opening is not None:
        _check(first, opening)
    header = Header(
        session_id=out.name,
        source=Source.IMPORT,
        software=software,
        brush=options.brush,
        brush_radius_mm=options.brush_radius_mm,
        brush_length_mm=options.brush_length_mm,
        protocol=protocol,
        licence=options.licence,
        origin=options.origin or f"{folder.resolve().name}, {table.name}",
    )
    stage = out.with_name(f".{out.name}.partial")
    try:
        shutil.rmtree(stage, ignore_errors=True)  # left by an import that was killed: a copy, nothing recorded
        stage.mkdir(parents=True)
        _write(rows, digests, stage / f"{out.name}.mcap", header, now_ns, first, encoded)
        stage.rename(out)
        fsync_folder(out.parent)
    except OSError as error:
        shutil.rmtree(stage, ignore_errors=True)
        raise InputError(out, f"cannot write: {in_one_line(error)}") from error
    except BaseException:
        shutil.rmtree(stage, ignore_errors=True)
        raise
    return out / f"{out.name}.mcap"


def _write(
    rows: list[Row],
    digests: list[bytes],
    final: Path,
    header: Header,
    now_ns: Callable[[], int],
    first: bytes | None,
    encoded: Callable[[Row], bytes],
) -> None:
    writer = SegmentWriter(final, header, QUEUE_LIMIT)
    try:
        if first is not None:
            t_ns = now_ns()
            writer.write(Outgoing(Topic.STILL, t_ns, t_ns, 0, image_message(t_ns, first, _kind(first))), WAIT_S)
        for row, digest in zip(rows, digests, strict=True):
            data, still = encoded(row), row.stroke.still
            if hashlib.sha256(data).digest() != digest:
                raise InputError(row.image, "changed while it was imported")
            t_ns = now_ns()
            writer.write(Outgoing(Topic.STILL, t_ns, t_ns, still, image_message(t_ns, data, _kind(data))), WAIT_S)
            writer.write(Outgoing(Topic.STROKE, t_ns, t_ns, still, row.stroke), WAIT_S)
    except BaseException:
        writer.abandon()
        raise
    writer.finish()


def _kind(data: bytes) -> str:
    return "png" if data.startswith(PNG_START) else "jpeg"


def _whole(row: Row) -> bytes:
    return read_bounded(row.image)


def _check(data: bytes, path: Path) -> bytes:
    """Decode it once; the digest lets it be read again without decoding. Raises `InputError`."""
    try:
        decode_gray(data, str(path))
    except SessionDamaged as error:
        raise InputError(path, error.what) from None
    return hashlib.sha256(data).digest()


def read_bounded(path: Path) -> bytes:
    """A photograph's bytes. Raises `InputError` where there are too many, or they cannot be read."""
    try:
        size = path.stat().st_size
        if size > MAX_IMAGE_BYTES:
            raise InputError(path, f"image of {size} bytes exceeds {MAX_IMAGE_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot read: {in_one_line(error)}") from None
