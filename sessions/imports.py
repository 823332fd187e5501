"""Import photographs: a folder of images and a table of what was commanded become a session.

The table has one line per photograph and columns named `quantity_unit`. It is checked before a photograph is read; a
refused import leaves nothing behind.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from brushloop.sessions.disk import SESSION_ID, as_text, number, read_bounded, staged_folder
from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.mcap_writer import Outgoing, new_mcap
from brushloop.sessions.messages import (
    MAX_IMAGE_BYTES,
    PNG_START,
    CompressedImage,
    decode_gray,
    image_message,
    upright,
)
from brushloop.sessions.records import MAX_PX_PER_MM, MIN_PX_PER_MM, Header, Source, Stroke, Topic
from brushloop.sessions.terminal import Progress, counted, unseen

MAX_TABLE_BYTES = 16 * 1024 * 1024
MAX_ROWS = 100_000
LENGTH_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
ANGLE_UNITS = {"deg": 1.0, "rad": 180.0 / math.pi}
FRACTIONS = ("frac", "px", "nominal", "ratio")
"""Suffixes of columns that are not converted: shares, pixels, and values that the source itself calls nominal."""
PAIRS = (("px_per_mm_x", "px_per_mm_y"), ("start_x_px", "start_y_px"))
SPECIAL = {"file", "name", "px_per_mm", "depth_mm", "tilt_deg", *PAIRS[0], *PAIRS[1]}
"""Columns that become fields of a stroke; all others are kept in `commanded`."""
EARLIER_NAMES = {"height_mm": "depth_mm"}
"""Columns of tables that were made when the depth was called a height."""
DEPTHS = ("height", "depth")
"""Prefixes of the names of columns that hold a depth, measured downwards from where the tip touches the paper."""
DEEPEST_MM = 500.0
STEEPEST_DEG = 90.0
MOST = 1e6
"""Limit of any other number: a length of a kilometre is a typing error."""
MAX_NAME_CHARS = 100
LINE = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")
"""A line with its end, whatever system wrote it."""


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
    rows = _read_table(folder.resolve(), table, options)
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
        with staged_folder(out) as stage, new_mcap(stage / f"{out.name}.mcap", header, {}, {}) as writer:
            for row in counted(rows, "photographs imported", len(rows), progress):
                t_ns, still = now_ns(), row.stroke.still
                writer.record(Outgoing(Topic.STILL, t_ns, t_ns, still, _photograph(row.image, t_ns)))
                writer.record(Outgoing(Topic.STROKE, t_ns, t_ns, still, row.stroke))
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


def _photograph(path: Path, t_ns: int) -> CompressedImage:
    """A photograph that can be decoded, as it is recorded. Raises `InputError`."""
    data = read_bounded(path, MAX_IMAGE_BYTES)
    try:
        decode_gray(data, str(path))
    except SessionDamaged as error:
        raise InputError(path, error.what) from None
    data = upright(data)
    return image_message(t_ns, data, "png" if data.startswith(PNG_START) else "jpeg")


@dataclass(frozen=True, slots=True)
class _Row:
    """Photograph, and what was commanded for it."""

    image: Path
    stroke: Stroke


def _read_table(folder: Path, path: Path, options: ImportOptions) -> list[_Row]:
    """Read and check every line of the table, without opening a photograph. Raises `InputError` for line and column."""
    if not path.is_file():
        raise InputError(path, "no such table")
    try:
        text = read_bounded(path, MAX_TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "is not UTF-8 text") from None
    lines = csv.reader((found[0] for found in LINE.finditer(text)), strict=True)
    rows: dict[str, _Row] = {}
    try:
        table = _Table(folder, path, options, next(lines, list[str]()))
        for cells in filter(any, lines):
            if len(rows) == MAX_ROWS:
                raise InputError(path, f"has more than {MAX_ROWS} rows")
            row = table.row(lines.line_num, [as_text(cell.strip()) for cell in cells], still=len(rows))
            if rows.setdefault(row.stroke.stroke_id, row) is not row:
                raise InputError(path, f"line {lines.line_num}: stroke {row.stroke.stroke_id} appears twice")
    except csv.Error as error:
        raise InputError(path, f"line {lines.line_num}: {error}") from None
    if not rows:
        raise InputError(path, "has no rows")
    return list(rows.values())


class _Table:
    """The header line of a table, by which its lines are read."""

    def __init__(self, folder: Path, path: Path, options: ImportOptions, names: list[str]) -> None:
        """`folder` is that of the photographs, with links resolved. Raises `InputError`."""
        self._folder, self._path, self._options = folder, path, options
        self._names = [EARLIER_NAMES.get(name.strip(), name.strip()) for name in names]
        self._check_names()
        self._commanded = {name: self._unit(name) for name in self._names if name not in SPECIAL}
        """Stored name and unit factor of each column that is not in `SPECIAL`."""
        stored = [self._commanded[name][0] if name in self._commanded else name for name in self._names]
        for name in stored:
            if stored.count(name) > 1:
                raise InputError(path, f"column `{name}` occurs twice, perhaps in two units")

    def row(self, line: int, cells: list[str], still: int) -> _Row:
        """One line of the table. Raises `InputError`."""
        if len(cells) != len(self._names):
            raise InputError(self._path, f"line {line} has {len(cells)} fields, expected {len(self._names)}")
        fields = dict(zip(self._names, cells, strict=True))

        def value(name: str, factor: float = 1.0) -> float:
            return self._number(line, name, fields[name], factor)

        def pair(first: str, second: str) -> tuple[float, float] | None:
            return (value(first), value(second)) if first in fields else None

        image = self._image(line, fields["file"])
        scale = pair("px_per_mm", "px_per_mm") or pair(*PAIRS[0])
        if scale is None and self._options.px_per_mm is not None:
            scale = (self._options.px_per_mm, self._options.px_per_mm)
        if scale is None or not all(MIN_PX_PER_MM <= s <= MAX_PX_PER_MM for s in scale):
            raise InputError(
                self._path, f"line {line}: px_per_mm = {scale}, allowed: {MIN_PX_PER_MM} to {MAX_PX_PER_MM}"
            )
        name = fields.get("name", image.relative_to(self._folder).with_suffix("").as_posix())
        if "name" in fields and (not name or not name.isprintable() or len(name) > MAX_NAME_CHARS):
            allowed = f"allowed are 1 to {MAX_NAME_CHARS} printable characters"
            raise self._wrong(line, "name", f"{name[:80]!r} is not a valid name; {allowed}")
        stroke = Stroke(
            stroke_id=name,
            kind="press" if self._options.kind == "press" else "drag",
            still=still,
            depth_mm=value("depth_mm") if "depth_mm" in fields else None,
            tilt_deg=value("tilt_deg") if "tilt_deg" in fields else None,
            anchor_px=pair(*PAIRS[1]),
            px_per_mm=scale,
            commanded={stored: value(column, factor) for column, (stored, factor) in self._commanded.items()},
        )
        return _Row(image, stroke)

    def _check_names(self) -> None:
        names, pressed = self._names, self._options.kind == "press"
        if not all(name.isprintable() for name in names):
            raise InputError(self._path, "line 1 holds control characters: the names of the columns are expected there")
        if "file" not in names:
            raise InputError(self._path, f"column `file` is missing; found: {', '.join(names)[:200] or 'none'}")
        if "px_per_mm" not in names and "px_per_mm_x" not in names and self._options.px_per_mm is None:
            what = "column `px_per_mm` (or px_per_mm_x and px_per_mm_y) is missing; or give --px-per-mm"
            raise InputError(self._path, what)
        required = [(name, "presses need it") for name in ("depth_mm", "tilt_deg", "start_x_px") if pressed]
        for first, second in PAIRS:
            required += [(b, f"`{a}` needs it") for a, b in ((first, second), (second, first)) if a in names]
        for name, why in required:
            if name not in names:
                raise InputError(self._path, f"column `{name}` is missing; {why}")

    def _unit(self, column: str) -> tuple[str, float]:
        """Stored name and unit factor of a column `quantity_unit`; lengths are stored in mm and angles in deg."""
        stem, _, suffix = column.rpartition("_")
        if suffix in LENGTH_UNITS and stem:
            return f"{stem}_mm", LENGTH_UNITS[suffix]
        if suffix in ANGLE_UNITS and stem:
            return f"{stem}_deg", ANGLE_UNITS[suffix]
        if any(part in FRACTIONS for part in column.split("_")):
            return column, 1.0
        allowed = ", ".join([*LENGTH_UNITS, *ANGLE_UNITS, *FRACTIONS])
        raise InputError(self._path, f"column `{column}` has no known unit; its name must end in one of: {allowed}")

    def _number(self, line: int, column: str, text: str, factor: float) -> float:
        """A number in its stored unit, within its range; a drag may lean to either side of its path."""
        least, most = -MOST, MOST
        if column.startswith(DEPTHS) and column.rpartition("_")[2] in LENGTH_UNITS:
            least, most = 0.0, DEEPEST_MM
        elif column == "tilt_deg":
            least, most = (0.0 if self._options.kind == "press" else -STEEPEST_DEG), STEEPEST_DEG
        try:
            stored = number(text) * factor
        except ValueError:
            stored = math.nan
        if not math.isfinite(stored):
            raise self._wrong(line, column, f"{text[:80]!r} is not a finite number")
        if not least <= stored <= most:
            raise self._wrong(line, column, f"{text[:80]!r}, allowed: {least / factor:g} to {most / factor:g}")
        return stored

    def _image(self, line: int, name: str) -> Path:
        """Path of the photograph, with links resolved. Raises `InputError` where it is not in the folder."""
        if not name.isprintable():
            raise self._wrong(line, "file", f"{name[:80]!r} holds control characters")
        image = self._folder / name
        try:
            image = image.resolve()
            inside, there = image.is_relative_to(self._folder), image.is_file()
        except (OSError, RuntimeError):
            inside = there = False  # the name is too long, or links form a loop
        if not (inside and there):
            where = "is not in" if inside else "lies outside"
            raise InputError(self._path, f"line {line}: file {name[:80]!r} {where} {self._folder.name}/")
        return image

    def _wrong(self, line: int, column: str, what: str) -> InputError:
        return InputError(self._path, f"line {line}, column `{column}`: {what}")
