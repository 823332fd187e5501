"""Import photographs: a folder of images and a table of what was commanded become a session.

Everything is read and checked before anything is written; a refused import leaves nothing behind.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from brushloop.sessions.disk import read_bounded, staged_folder
from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.imports.table import Row, parse_table, read_text
from brushloop.sessions.messages import MAX_IMAGE_BYTES, PNG_START, decode_gray, image_message, upright
from brushloop.sessions.names import SESSION_ID
from brushloop.sessions.progress import Progress, counted, unseen
from brushloop.sessions.records import Header, Source, Topic
from brushloop.sessions.spool import Spool
from brushloop.sessions.step_file import Outgoing, SegmentWriter

QUEUE_LIMIT = 16
"""Most photographs queued for writing; an import waits when the queue is full, and memory stays bounded."""
WAIT_S = 60.0


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Facts about an import that its table does not contain."""

    kind: str = "drag"
    """`press` for vertical presses, `drag` for strokes with travel along the paper."""
    px_per_mm: float | None = None
    """Scale for tables without px_per_mm columns."""
    licence: str = ""
    origin: str = ""
    brush: str = ""
    brush_radius_mm: float | None = None
    """R and L of the bundle, for the models of presses; None for the paper's nominal brush."""
    brush_length_mm: float | None = None
    simulated: bool = False
    """Declares that the ink was simulated; every report says so."""


def import_photographs(
    folder: Path,
    table: Path,
    out: Path,
    options: ImportOptions,
    software: str,
    now_ns: Callable[[], int],
    *,
    progress: Progress = unseen,
) -> Path:
    """Import into the new session folder `out`; return its MCAP file. Raises `InputError`, leaving nothing behind."""
    _check_target(folder, table, out, options)
    kind = "press" if options.kind == "press" else "drag"
    rows = parse_table(folder, table, read_text(table), kind, options.px_per_mm)
    checked = counted(rows, "photographs checked", len(rows), progress)
    digests = [_check(_read(row.image), row.image) for row in checked]
    header = Header(
        session_id=out.name,
        source=Source.IMPORT_SIMULATED if options.simulated else Source.IMPORT,
        software=software,
        brush=options.brush,
        brush_radius_mm=options.brush_radius_mm,
        brush_length_mm=options.brush_length_mm,
        protocol=f"import of {len(rows)} {options.kind} strokes",
        licence=options.licence,
        origin=options.origin or f"{folder.resolve().name}, {table.name}",
    )
    try:
        with staged_folder(out) as stage:
            _write(rows, digests, stage / f"{out.name}.mcap", header, now_ns, progress)
    except OSError as error:
        raise InputError(out, f"cannot write: {in_one_line(error)}") from error
    return out / f"{out.name}.mcap"


def _check_target(folder: Path, table: Path, out: Path, options: ImportOptions) -> None:
    """Raise `InputError` for a folder, a target or a kind that cannot be used."""
    if not folder.is_dir():
        raise InputError(folder, "is not a folder of photographs")
    if out.exists():
        raise InputError(out, "exists already; recordings are never overwritten")
    if not SESSION_ID.fullmatch(out.name):
        raise InputError(out, "a session's name is letters, digits, '.', '_' and '-', at most 100 of them")
    if options.kind not in ("press", "drag"):
        raise InputError(table, f"--kind is {options.kind!r}, allowed: press, drag")


def _write(
    rows: Spool[Row],
    digests: list[bytes],
    final: Path,
    header: Header,
    now_ns: Callable[[], int],
    progress: Progress,
) -> None:
    writer = SegmentWriter(final, header, QUEUE_LIMIT)
    try:
        pairs = zip(rows, digests, strict=True)
        for row, digest in counted(pairs, "photographs written", len(rows), progress):
            data, still = _read(row.image), row.stroke.still
            if hashlib.sha256(data).digest() != digest:
                raise InputError(row.image, "changed while it was imported")
            data = upright(data)
            t_ns = now_ns()
            writer.write(Outgoing(Topic.STILL, t_ns, t_ns, still, image_message(t_ns, data, _kind(data))), WAIT_S)
            writer.write(Outgoing(Topic.STROKE, t_ns, t_ns, still, row.stroke), WAIT_S)
    except BaseException:
        writer.abandon()
        raise
    writer.finish()


def _kind(data: bytes) -> str:
    return "png" if data.startswith(PNG_START) else "jpeg"


def _check(data: bytes, path: Path) -> bytes:
    """Check that a photograph can be decoded, and return its digest for later checks. Raises `InputError`."""
    try:
        decode_gray(data, str(path))
    except SessionDamaged as error:
        raise InputError(path, error.what) from None
    return hashlib.sha256(data).digest()


def _read(path: Path) -> bytes:
    """Bytes of a photograph. Raises `InputError` if it is too large or cannot be read."""
    return read_bounded(path, MAX_IMAGE_BYTES)
