"""Import photographs: a folder of images and a table of what was commanded become a session.

The table has one line per photograph and columns named `quantity_unit`. It is checked before a photograph is read; a
refused import leaves nothing behind. The boxes of a printed sheet are photographs that the table names by their `box`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from brushloop.sessions.disk import SESSION_ID, as_text, number, read_bounded, staged_folder
from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.mcap_writer import Outgoing, new_mcap
from brushloop.sessions.messages import MAX_IMAGE_BYTES, PNG_START, CompressedImage, decode_gray, image_message
from brushloop.sessions.records import Header, Source, Stroke, Topic
from brushloop.sessions.terminal import Progress, counted, unseen

MAX_TABLE_BYTES = 16 * 1024 * 1024
PAIRS = (("px_per_mm_x", "px_per_mm_y"), ("start_x_px", "start_y_px"))
PRESSED = ("depth_mm", "tilt_deg", *PAIRS[1])
"""Columns that presses need."""
SPECIAL = {"px_per_mm", "depth_mm", "tilt_deg", *PAIRS[0], *PAIRS[1]}
"""Columns of numbers that become fields of a stroke; all others are kept in `commanded`."""
EARLIER_NAMES = {"height_mm": "depth_mm"}
"""Columns of tables that were made when the depth was called a height, such as those of the bristle simulation."""
MAX_NAME_CHARS = 100


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Facts about an import that its table does not contain."""

    kind: Literal["press", "drag"] = "press"
    """`press` for vertical presses, `drag` for strokes with travel along the paper."""
    px_per_mm: float | None = None
    """Scale for tables without px_per_mm columns."""
    start_px: tuple[float, float] | None = None
    """Photographs of a printed sheet's boxes: where every stroke starts. The table then has a column `box`."""
    licence: str = ""
    origin: str = ""
    brush: str = ""
    brush_radius_mm: float = 6.0
    """R and L of the bundle, for the models of presses; the paper's nominal brush by default."""
    brush_length_mm: float = 48.0
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
    if not folder.is_dir():
        raise InputError(folder, "is not a folder of photographs")
    if out.exists():
        raise InputError(out, "exists already and is not overwritten: name another folder with --out")
    if not SESSION_ID.fullmatch(out.name):
        raise InputError(out, "a session's name consists of at most 100 letters, digits, '.', '_' and '-'")
    rows = read_table(folder.resolve(), table, options)
    header = Header(
        session_id=out.name,
        source=Source.IMPORT_SIMULATED if options.simulated else Source.IMPORT,
        software=software,
        brush=options.brush,
        brush_radius_mm=options.brush_radius_mm if options.kind == "press" else None,
        brush_length_mm=options.brush_length_mm if options.kind == "press" else None,
        protocol=f"import of {len(rows)} {options.kind} strokes",
        licence=options.licence,
        origin=options.origin or f"{folder.resolve().name}, {table.name}",
    )
    try:
        with staged_folder(out) as stage, new_mcap(stage / f"{out.name}.mcap", header, {}) as writer:
            for image, stroke in counted(rows, "photographs imported", len(rows), progress):
                t_ns = now_ns()
                writer.record(Outgoing(Topic.STILL, t_ns, t_ns, stroke.still, _photograph(image, stroke, t_ns)))
                writer.record(Outgoing(Topic.STROKE, t_ns, t_ns, stroke.still, stroke))
    except OSError as error:
        raise InputError(out, f"cannot write: {in_one_line(error)}") from error
    return out / f"{out.name}.mcap"


def _photograph(path: Path, stroke: Stroke, t_ns: int) -> CompressedImage:
    """A photograph that can be decoded and shows the start of its stroke, as it is recorded. Raises `InputError`."""
    data = read_bounded(path, MAX_IMAGE_BYTES)
    try:
        height, width = decode_gray(data, str(path)).shape
    except SessionDamaged as error:
        raise InputError(path, error.what) from None
    x, y = stroke.anchor_px or (0, 0)
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(path, f"its {width} x {height} pixels do not show (start_x_px, start_y_px) = ({x:g}, {y:g})")
    return image_message(t_ns, data, "png" if data.startswith(PNG_START) else "jpeg")


def read_table(folder: Path, path: Path, options: ImportOptions) -> list[tuple[Path, Stroke]]:
    """Read and check every line of the table, without opening a photograph. Raises `InputError` for line and column.

    `folder` is that of the photographs, with links resolved.
    """
    try:
        text = read_bounded(path, MAX_TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "is not UTF-8 text") from None
    lines = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: dict[str, tuple[Path, Stroke]] = {}
    try:
        names = [EARLIER_NAMES.get(name, name) for name in _texts(next(lines, list[str]()))]
        _check_columns(names, options)
        file, ending = ("file", "") if options.start_px is None else ("box", ".png")
        for cells in filter(any, lines):
            if len(cells) != len(names):
                raise ValueError(f"{len(cells)} fields, expected {len(names)}")
            fields = dict(zip(names, _texts(cells), strict=True))
            image = _image(folder, fields[file], ending)
            if image is None:
                raise ValueError(f"{file} {fields[file][:80]!r} is not in {folder.name}/")
            name = fields.get("name", image.relative_to(folder).with_suffix("").as_posix())
            if "name" in fields and not 0 < len(name) <= MAX_NAME_CHARS:
                raise ValueError(f"column `name`: {name[:80]!r}, allowed: 1 to {MAX_NAME_CHARS} characters")
            if name in rows:
                raise ValueError(f"stroke {name} appears twice")
            values = {column: _value(column, fields[column]) for column in names if column not in (file, "name")}
            rows[name] = image, _stroke(name, len(rows), values, options)
    except (ValueError, csv.Error) as error:
        raise InputError(path, f"line {max(lines.line_num, 1)}: {error}") from None
    if not rows:
        raise InputError(path, "has no rows")
    return list(rows.values())


def _texts(cells: list[str]) -> list[str]:
    """What the cells of a line say. Raises `ValueError` for control characters."""
    texts = [as_text(cell.strip()) for cell in cells]
    for text in texts:
        if not text.isprintable():
            raise ValueError(f"{text[:80]!r} holds control characters")
    return texts


def _check_columns(names: list[str], options: ImportOptions) -> None:
    """Raise `ValueError` for columns that are missing or not distinct."""
    file = "file" if options.start_px is None else "box"
    if file not in names:
        raise ValueError(f"column `{file}` is missing; found: {', '.join(names)[:200] or 'none'}")
    if "px_per_mm" not in names and "px_per_mm_x" not in names and options.px_per_mm is None:
        raise ValueError("column `px_per_mm` (or px_per_mm_x and px_per_mm_y) is missing; or give --px-per-mm")
    required = [name for pair in PAIRS for name in pair if not set(pair).isdisjoint(names)]
    pressed = PRESSED if options.start_px is None else PRESSED[:2]
    for name in (*(pressed if options.kind == "press" else ()), *required):
        if name not in names:
            raise ValueError(f"column `{name}` is missing")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"column `{name}` occurs twice")


def _value(column: str, text: str) -> float:
    try:
        return number(text)
    except ValueError as error:
        raise ValueError(f"column `{column}`: {error}") from None


def _stroke(name: str, still: int, values: dict[str, float], options: ImportOptions) -> Stroke:
    """What the values of a line say, those without a field of their own in `commanded`. Raises `ValueError`."""

    def pair(first: str, second: str) -> tuple[float, float] | None:
        return (values[first], values[second]) if first in values else None

    scale = None if options.px_per_mm is None else (options.px_per_mm, options.px_per_mm)
    try:
        return Stroke(
            stroke_id=name,
            kind=options.kind,
            still=still,
            depth_mm=values.get("depth_mm"),
            tilt_deg=values.get("tilt_deg"),
            anchor_px=pair(*PAIRS[1]) or options.start_px,
            px_per_mm=pair("px_per_mm", "px_per_mm") or pair(*PAIRS[0]) or scale,
            commanded={name: value for name, value in values.items() if name not in SPECIAL},
        )
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        raise ValueError(f"column `{problem['loc'][0]}`: {problem['input']}, {problem['msg'].lower()}") from None


def _image(folder: Path, name: str, ending: str) -> Path | None:
    """Path of a photograph, with links resolved; None where it is not in the folder."""
    try:
        image = (folder / (name + ending)).resolve()
        return image if image.is_relative_to(folder) and image.is_file() else None
    except (OSError, RuntimeError):
        return None  # the name is too long, or links form a loop
