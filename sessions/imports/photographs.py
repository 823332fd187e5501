"""Import photographs or flatbed scans: a folder of images and a table of what was commanded become a session.

Everything is read and checked before anything is written; a refused import leaves nothing behind.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from sessions.disk import staged_folder
from sessions.errors import InputError, SessionDamaged, in_one_line
from sessions.imports.table import Row, parse_table, read_text
from sessions.names import SESSION_ID
from sessions.progress import Progress, counted, unseen
from sessions.recording.messages import MAX_IMAGE_BYTES, PNG_START, decode_gray, encode_png, image_message
from sessions.recording.schemas import Header, Source, Topic
from sessions.recording.writer import Outgoing, SegmentWriter
from sessions.spool import Spool

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

QUEUE_LIMIT = 16
"""Most photographs queued for writing; an import waits when the queue is full, and memory stays bounded."""
WAIT_S = 60.0
MM_PER_INCH = 25.4
LEAST_DPI, MOST_DPI = 20.0, 10_000.0
BOX = ("left_px", "top_px", "width_px", "height_px")
LEAST_BOX_PX = 8
SCANS_KEPT = 2
"""Decoded scans kept in memory, tens of megabytes each; a table lists its strokes sheet by sheet."""


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
    check_target(folder, table, out, options)
    kind = "press" if options.kind == "press" else "drag"
    rows = parse_table(folder, table, read_text(table), kind, options.px_per_mm)
    protocol = f"import of {len(rows)} {options.kind} strokes"
    return store_rows(rows, folder, table, out, options, protocol, software, now_ns, progress=progress)


def import_scans(
    folder: Path,
    table: Path,
    out: Path,
    options: ImportOptions,
    software: str,
    now_ns: Callable[[], int],
    dpi: float | None = None,
    *,
    progress: Progress = unseen,
) -> Path:
    """Import scans into a new session folder `out`; return its MCAP file. Raises `InputError`, leaving nothing behind.

    The table is that of any import, without px_per_mm: the scale is `dpi`, or else the dpi stored in each file. If it
    has the columns `BOX` (in pixels from the scan's upper left corner) and `name`, each line is the stroke in that box.
    """
    check_target(folder, table, out, options)
    text = read_text(table)
    head = [name.strip() for name in text.split("\n", 1)[0].split(",")]
    boxed = [name for name in BOX if name in head]
    if boxed and (len(boxed) < len(BOX) or "name" not in head):
        raise InputError(table, f"needs all of {', '.join(BOX)} and `name`, or none of the boxes")
    if any(name.startswith("px_per_mm") for name in head):
        raise InputError(table, "has a px_per_mm column: the scale of a scan is its dpi")
    kind = "press" if options.kind == "press" else "drag"
    # 1.0 stands for the scale until it is known from the file.
    rows = Row.spooled(_scaled(row, dpi) for row in parse_table(folder, table, text, kind, 1.0))
    protocol = f"import of {len(rows)} {options.kind} strokes from scans"
    gray = lru_cache(maxsize=SCANS_KEPT)(gray_of)

    def cut(row: Row) -> bytes:
        if not boxed:
            return read_bounded(row.image)
        image = gray(row.image)
        left, top, width, height = (round(row.stroke.commanded[name]) for name in BOX)
        inside = min(left, top) >= 0 and left + width <= image.shape[1] and top + height <= image.shape[0]
        if not inside or min(width, height) < LEAST_BOX_PX:
            box = f"stroke {row.stroke.stroke_id}: the box {left}, {top}, {width}, {height} is not within"
            raise InputError(
                table, f"{box} {image.shape[1]} x {image.shape[0]} px, or less than {LEAST_BOX_PX} px wide"
            )
        return encode_png(image[top : top + height, left : left + width])

    return store_rows(rows, folder, table, out, options, protocol, software, now_ns, encoded=cut, progress=progress)


def dpi_of(data: bytes) -> tuple[float, float] | None:
    """Horizontal and vertical dpi of a PNG (pHYs) or JPEG (JFIF density); None where the file has none."""
    if data.startswith(PNG_START):
        at = data.find(b"pHYs", 8, 65536)
        if at < 0 or len(data) < at + 13:
            return None
        across, along, unit = struct.unpack_from(">IIB", data, at + 4)
        return (across * 0.0254, along * 0.0254) if unit == 1 and across and along else None
    if data[2:4] == b"\xff\xe0" and data[6:11] == b"JFIF\0" and len(data) >= 18:
        unit, across, along = struct.unpack_from(">BHH", data, 13)
        factor = {1: 1.0, 2: 2.54}.get(unit)
        return (across * factor, along * factor) if factor and across and along else None
    return None


def _scaled(row: Row, dpi: float | None) -> Row:
    found = (dpi, dpi) if dpi is not None else dpi_of(read_bounded(row.image))
    if found is None:
        raise InputError(row.image, "does not say its dpi; give --dpi")
    if not all(LEAST_DPI <= value <= MOST_DPI for value in found):
        raise InputError(
            row.image, f"dpi {found[0]:g} x {found[1]:g}, allowed {LEAST_DPI:g} to {MOST_DPI:g}; give --dpi"
        )
    scale = (found[0] / MM_PER_INCH, found[1] / MM_PER_INCH)
    return Row(row.image, row.stroke.model_copy(update={"px_per_mm": scale}))


def gray_of(path: Path) -> NDArray[np.uint8]:
    """A photograph as (h, w) uint8 gray. Raises `InputError`."""
    return _gray(read_bounded(path), path)


def _gray(data: bytes, path: Path) -> NDArray[np.uint8]:
    try:
        return decode_gray(data, str(path))
    except SessionDamaged as error:
        raise InputError(path, error.what) from None


def check_target(folder: Path, table: Path, out: Path, options: ImportOptions) -> None:
    """Raise `InputError` for a folder, a target or a kind that cannot be used."""
    if not folder.is_dir():
        raise InputError(folder, "is not a folder of photographs")
    if out.exists():
        raise InputError(out, "exists already; recordings are never overwritten")
    if not SESSION_ID.fullmatch(out.name):
        raise InputError(out, "a session's name is letters, digits, '.', '_' and '-', at most 100 of them")
    if options.kind not in ("press", "drag"):
        raise InputError(table, f"--kind is {options.kind!r}, allowed: press, drag")


def store_rows(
    rows: Spool[Row],
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
    progress: Progress = unseen,
) -> Path:
    """Write strokes with their photographs into the session folder `out` and return its MCAP file.

    `opening` is a photograph that comes first and has no stroke. `encoded` returns a stroke's PNG or JPEG, by default
    its file unchanged. Raises `InputError`, leaving nothing behind.
    """
    encoded = encoded or (lambda row: read_bounded(row.image))
    checked = counted(rows, "photographs checked", len(rows), progress)
    digests = [_check(encoded(row), row.image) for row in checked]
    first = None if opening is None else read_bounded(opening)
    if first is not None and opening is not None:
        _check(first, opening)
    header = Header(
        session_id=out.name,
        source=Source.IMPORT_SIMULATED if options.simulated else Source.IMPORT,
        software=software,
        brush=options.brush,
        brush_radius_mm=options.brush_radius_mm,
        brush_length_mm=options.brush_length_mm,
        protocol=protocol,
        licence=options.licence,
        origin=options.origin or f"{folder.resolve().name}, {table.name}",
    )
    try:
        with staged_folder(out) as stage:
            _write(rows, digests, stage / f"{out.name}.mcap", header, now_ns, first, encoded, progress)
    except OSError as error:
        raise InputError(out, f"cannot write: {in_one_line(error)}") from error
    return out / f"{out.name}.mcap"


def _write(
    rows: Spool[Row],
    digests: list[bytes],
    final: Path,
    header: Header,
    now_ns: Callable[[], int],
    first: bytes | None,
    encoded: Callable[[Row], bytes],
    progress: Progress,
) -> None:
    writer = SegmentWriter(final, header, QUEUE_LIMIT)
    try:
        if first is not None:
            t_ns = now_ns()
            writer.write(Outgoing(Topic.STILL, t_ns, t_ns, 0, image_message(t_ns, first, _kind(first))), WAIT_S)
        pairs = zip(rows, digests, strict=True)
        for row, digest in counted(pairs, "photographs written", len(rows), progress):
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


def _check(data: bytes, path: Path) -> bytes:
    """Check that a photograph can be decoded, and return its digest for later checks. Raises `InputError`."""
    _gray(data, path)
    return hashlib.sha256(data).digest()


def read_bounded(path: Path) -> bytes:
    """Bytes of a photograph. Raises `InputError` if it is too large or cannot be read."""
    try:
        size = path.stat().st_size
        if size > MAX_IMAGE_BYTES:
            raise InputError(path, f"image of {size} bytes exceeds {MAX_IMAGE_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot read: {in_one_line(error)}") from None
