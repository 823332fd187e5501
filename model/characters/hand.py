"""Parse a trajectory supplied by the user: points with the width that the stroke should have there. Reads no files.

CSV with the columns `x_mm`, `y_mm`, `width_mm` and, for several strokes, `stroke` (a number that changes from
one stroke to the next); or JSON, `{"strokes": [[[x_mm, y_mm, width_mm], ...], ...]}`. Positions are relative to the
cell's lower left corner.
"""

from __future__ import annotations

import csv
import io
import math
from typing import Any, cast

import numpy as np

from brushloop.model.characters.glyph import GlyphError, json_of
from brushloop.model.characters.plan import Cell, Path, resampled

MAX_CHARS = 4 * 1024 * 1024
MAX_STROKES, MAX_POINTS = 100, 10_000
MAX_WIDTH_MM = 100.0
COLUMNS = ("x_mm", "y_mm", "width_mm")

Strokes = list[list[tuple[float, float, float]]]


def parse_csv(text: str, cell: Cell, step_mm: float) -> list[Path]:
    """The paths of a CSV; raises GlyphError, which names line and column."""
    if len(text) > MAX_CHARS:
        raise GlyphError("", f"is longer than {MAX_CHARS} characters")
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    strokes: Strokes = []
    last: str | None = None
    try:
        header = [name.strip() for name in next(rows, [])]
        for name in COLUMNS:
            if name not in header:
                raise GlyphError("line 1", f"has no column {name}")
        if extra := [name for name in header if name not in (*COLUMNS, "stroke")]:
            raise GlyphError("line 1", f"unknown column {extra[0][:40]!r}; known: stroke, {', '.join(COLUMNS)}")
        for cells in rows:
            if not cells:
                continue
            where = f"line {rows.line_num}"
            if len(cells) != len(header):
                raise GlyphError(where, f"{len(cells)} cells under {len(header)} columns")
            named = dict(zip(header, cells, strict=True))
            if named.get("stroke", "") != last or not strokes:
                last = named.get("stroke", "")
                strokes.append([])
            strokes[-1].append(_point([named[name] for name in COLUMNS], where, cell))
            _bounded(strokes, where)
    except csv.Error as error:
        raise GlyphError(f"line {rows.line_num}", f"is not CSV: {error}") from None
    return _paths(strokes, step_mm)


def parse_json(text: str, cell: Cell, step_mm: float) -> list[Path]:
    """The paths of a JSON trajectory; raises GlyphError, which names stroke and point."""
    data = json_of(text, MAX_CHARS)
    given = cast("dict[str, Any]", data).get("strokes") if isinstance(data, dict) else None
    if not isinstance(given, list):
        raise GlyphError("strokes", "expected a list of strokes")
    strokes: Strokes = []
    for k, stroke in enumerate(cast("list[Any]", given)):
        if not isinstance(stroke, list):
            raise GlyphError(f"strokes.{k}", "expected a list of points")
        strokes.append([])
        for n, point in enumerate(cast("list[Any]", stroke)):
            where = f"strokes.{k}.{n}"
            if not isinstance(point, list) or len(cast("list[Any]", point)) != len(COLUMNS):
                raise GlyphError(where, f"expected [{', '.join(COLUMNS)}]")
            strokes[-1].append(_point(cast("list[Any]", point), where, cell))
            _bounded(strokes, where)
    return _paths(strokes, step_mm)


def _point(values: list[Any], where: str, cell: Cell) -> tuple[float, float, float]:
    out: list[float] = []
    for name, value in zip(COLUMNS, values, strict=True):
        low, high = (0.0, MAX_WIDTH_MM) if name == "width_mm" else (0.0, cell.side_mm)
        try:
            number = math.nan if isinstance(value, bool) or "_" in str(value) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not low <= number <= high:
            raise GlyphError(f"{where}: {name}", f"must be a number, {low:g} to {high:g} (given: {value!r:.40})")
        out.append(number)
    return out[0], out[1], out[2]


def _bounded(strokes: Strokes, where: str) -> None:
    if len(strokes) > MAX_STROKES or sum(map(len, strokes)) > MAX_POINTS:
        raise GlyphError(where, f"more than {MAX_STROKES} strokes or {MAX_POINTS} points")


def _paths(strokes: Strokes, step_mm: float) -> list[Path]:
    if not strokes:
        raise GlyphError("", "holds no stroke")
    out: list[Path] = []
    for k, stroke in enumerate(strokes):
        points = np.array(stroke)
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))))
        if along[-1] < 2 * step_mm:
            raise GlyphError(f"stroke {k + 1}", f"is {along[-1]:.3g} mm long, expected at least {2 * step_mm:g} mm")
        even = resampled(points[:, :2], step_mm)
        at = np.linspace(0, along[-1], len(even))
        out.append(Path(even, 0.5 * np.interp(at, along, points[:, 2])))
    return out
