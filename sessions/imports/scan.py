"""Flatbed scans become a session: the scale is the scan's dpi, and one sheet may hold many strokes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from sessions.errors import InputError, SessionDamaged
from sessions.imports.photographs import ImportOptions, check_target, read_bounded, store_rows
from sessions.imports.table import Row, parse_table, read_text
from sessions.recording.messages import PNG_START, decode_gray, encode_png

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MM_PER_INCH = 25.4
LEAST_DPI, MOST_DPI = 20.0, 10_000.0
BOX = ("left_px", "top_px", "width_px", "height_px")
LEAST_BOX_PX = 8
SCANS_KEPT = 2
"""A table goes through its sheets one after the other; a decoded sheet is tens of megabytes."""


def import_scans(
    folder: Path,
    table: Path,
    out: Path,
    options: ImportOptions,
    software: str,
    now_ns: Callable[[], int],
    dpi: float | None = None,
) -> Path:
    """Import scans into the new session folder `out`; returns its MCAP file. Raises `InputError`, nothing is left then.

    The table is that of any import, without px_per_mm: the scale is `dpi`, or what the files themselves say. Where it
    has the columns `BOX` (pixels of the scan, from its upper left corner) and `name`, a line is the stroke in that box.
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
    # Any scale will do until the files are looked at.
    rows = [_scaled(row, dpi) for row in parse_table(folder, table, text, kind, 1.0)]
    protocol = f"import of {len(rows)} {options.kind} strokes from scans"
    gray = lru_cache(maxsize=SCANS_KEPT)(_gray)

    def cut(row: Row) -> bytes:
        if not boxed:
            return read_bounded(row.image)
        image = gray(row.image)
        left, top, width, height = (round(row.stroke.commanded[name]) for name in BOX)
        inside = min(left, top) >= 0 and left + width <= image.shape[1] and top + height <= image.shape[0]
        if not inside or min(width, height) < LEAST_BOX_PX:
            told = f"stroke {row.stroke.stroke_id}: the box {left}, {top}, {width}, {height} is not within"
            raise InputError(
                table, f"{told} {image.shape[1]} x {image.shape[0]} px, or less than {LEAST_BOX_PX} px wide"
            )
        return encode_png(image[top : top + height, left : left + width])

    return store_rows(rows, folder, table, out, options, protocol, software, now_ns, encoded=cut)


def dpi_of(data: bytes) -> tuple[float, float] | None:
    """Horizontal and vertical dpi of a PNG (pHYs) or JPEG (JFIF density); None where the file does not tell."""
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
    told = (dpi, dpi) if dpi is not None else dpi_of(read_bounded(row.image))
    if told is None:
        raise InputError(row.image, "does not say its dpi; give --dpi")
    if not all(LEAST_DPI <= value <= MOST_DPI for value in told):
        raise InputError(row.image, f"dpi {told[0]:g} x {told[1]:g}, allowed {LEAST_DPI:g} to {MOST_DPI:g}; give --dpi")
    scale = (told[0] / MM_PER_INCH, told[1] / MM_PER_INCH)
    return Row(row.image, row.stroke.model_copy(update={"px_per_mm": scale}))


def _gray(path: Path) -> NDArray[np.uint8]:
    try:
        return decode_gray(read_bounded(path), str(path))
    except SessionDamaged as error:
        raise InputError(path, error.what) from None
