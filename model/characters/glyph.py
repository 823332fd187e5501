"""What is written, and its image: a character of hanzi-writer or makemeahanzi, or a trajectory of the user's.

A character has an outline and a median for each stroke, in font units: 1024 per side, x to the right, y upward from
-124 at the bottom to 900 at the top. A trajectory has the width that the stroke should have at each point. It is CSV
with the columns `x_mm`, `y_mm`, `width_mm` and, for several strokes, `stroke` (a number that changes from one stroke
to the next); or JSON, `{"strokes": [[[x_mm, y_mm, width_mm], ...], ...]}`. Positions are relative to the patch's lower
left corner. The data is not trusted: sizes are bounded, and an error is one line.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from brushloop.model.characters.plan import Floats, Image, Patch, StrokePath, grid, lengths_along, resampled
from brushloop.model.outline import Outline
from brushloop.model.raster import SIZE_PX, coverage

MAX_GLYPH_CHARS, MAX_TRAJECTORY_CHARS = 256 * 1024, 4 * 1024 * 1024
MAX_STROKES, MAX_MEDIAN, MAX_SEGMENTS = 64, 256, 1024
MAX_UNITS = 4096.0
MAX_DRAWN_STROKES, MAX_POINTS = 100, 10_000
MAX_WIDTH_MM = 100.0
COLUMNS = ("x_mm", "y_mm", "width_mm")
_CUBIC_PIECES = 8
_COMMAND = re.compile(r"([A-DF-Za-df-z])([^A-DF-Za-df-z]*)")  # an E belongs to a number
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d{1,3})?", re.IGNORECASE)
_TAKES = {"M": 2, "L": 2, "Q": 4, "C": 6, "Z": 0}


class GlyphError(ValueError):
    """Data that is not a character; `field` says where, `what` says what is wrong there."""

    def __init__(self, field: str, what: str) -> None:
        super().__init__(f"{field}: {what}" if field else what)
        self.field = field
        self.what = what


@dataclass(frozen=True, slots=True)
class GlyphStroke:
    """One stroke in font units: `arcs` (K, 3, 2), the outline as a closed loop of parabolas, counter-clockwise, and
    `median` (N, 2), the path of the brush."""

    arcs: Floats
    median: Floats

    def polyline(self, per_arc: int = 8) -> Floats:
        """Points on the outline in order, (K per_arc, 2); the last joins the first."""
        t = np.arange(per_arc)[:, None] / per_arc
        start, middle, end = (self.arcs[:, None, k] for k in range(3))
        return ((1 - t) ** 2 * start + 2 * t * (1 - t) * middle + t**2 * end).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class Glyph:
    """A character: its name and strokes in the order of writing."""

    name: str
    strokes: tuple[GlyphStroke, ...]


def parse_glyph(text: str, name: str) -> Glyph:
    """Parse a character from `{"strokes": [path, ...], "medians": [[[x, y], ...], ...]}`; raises GlyphError."""
    data = _json_of(text, MAX_GLYPH_CHARS)
    if not isinstance(data, dict):
        raise GlyphError("", "is not a JSON object")
    table = cast("dict[str, Any]", data)
    paths, medians = (_list(table.get(key), key, 1, MAX_STROKES) for key in ("strokes", "medians"))
    if len(paths) != len(medians):
        raise GlyphError("medians", f"{len(medians)} for {len(paths)} strokes")
    strokes: list[GlyphStroke] = []
    for k, (path, median) in enumerate(zip(paths, medians, strict=True)):
        if not isinstance(path, str):
            raise GlyphError(f"strokes.{k}", "is not text")
        strokes.append(GlyphStroke(parse_path(path, f"strokes.{k}"), _median(median, f"medians.{k}")))
    return Glyph(name, tuple(strokes))


def parse_path(path: str, field: str) -> Floats:
    """Parse a closed SVG path of absolute M, L, Q, C and Z into arcs (K, 3, 2); raises GlyphError."""
    if not path.lstrip().startswith("M"):
        raise GlyphError(field, "expected M first, then L, Q, C or Z")
    arcs: list[Floats] = []
    at = begin = np.zeros(2)
    for number, command in enumerate(_COMMAND.finditer(path)):
        letter, pieces = _pieces(command, field)
        if letter == "M" and number > 0:
            raise GlyphError(field, "has more than one loop")
        for k, points in enumerate(pieces if letter != "Z" else [begin[None]]):
            if letter == "M" and k == 0:
                at = begin = points[0]
            elif letter == "C":
                arcs.extend(_cubic(np.stack((at, *points))))
            elif letter == "Q":
                arcs.append(np.stack((at, *points)))
            elif not np.allclose(at, points[0]):  # further pairs after M are lines, as in SVG
                arcs.append(np.stack((at, 0.5 * (at + points[0]), points[0])))
            at = points[-1]
        if len(arcs) > MAX_SEGMENTS:
            raise GlyphError(field, f"has more than {MAX_SEGMENTS} pieces")
    if len(arcs) < 2:
        raise GlyphError(field, "encloses nothing")
    if not np.allclose(at, begin):
        arcs.append(np.stack((at, 0.5 * (at + begin), begin)))
    loop = np.stack(arcs)
    x, y = GlyphStroke(loop, loop[:, 0]).polyline(4).T
    area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    if abs(area) < 1.0:
        raise GlyphError(field, "encloses nothing")
    return loop if area > 0 else np.ascontiguousarray(loop[::-1, ::-1])


def _pieces(command: re.Match[str], field: str) -> tuple[str, Floats]:
    """The letter of a command, and its points (pieces, points of a piece, 2)."""
    letter, text = command.groups()
    takes = _TAKES.get(letter)
    if takes is None:
        raise GlyphError(field, f"{letter} at character {command.start() + 1}: expected M first, then L, Q, C or Z")
    if rest := _NUMBER.sub("", text).replace(",", " ").split():
        raise GlyphError(field, f"is not a path at character {command.start() + 1}: {rest[0][:12]!r}")
    numbers = np.array(_NUMBER.findall(text), np.float64)
    if (numbers.size % takes if takes else numbers.size) or bool(takes) != bool(numbers.size):
        raise GlyphError(field, f"{letter} takes {takes} numbers at a time")
    if np.any(np.abs(numbers) > MAX_UNITS):
        raise GlyphError(field, f"number at character {command.start() + 1}: expected {MAX_UNITS:g} at most")
    return letter, numbers.reshape(-1, max(takes // 2, 1), 2)


def _cubic(nodes: Floats) -> list[Floats]:
    """Approximate a cubic curve by parabolas, each through three of its points."""
    t = np.linspace(0, 1, 2 * _CUBIC_PIECES + 1)[:, None]
    p, q, r, s = nodes
    on = (1 - t) ** 3 * p + 3 * t * (1 - t) ** 2 * q + 3 * t**2 * (1 - t) * r + t**3 * s
    start, middle, end = on[:-1:2], on[1::2], on[2::2]
    return list(np.stack((start, 2 * middle - 0.5 * (start + end), end), axis=1))


def _median(value: object, field: str) -> Floats:
    points: list[list[float]] = []
    for n, point in enumerate(_list(value, field, 2, MAX_MEDIAN, "points")):
        pair = cast("list[Any]", point) if isinstance(point, list) else []
        good = len(pair) == 2 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in pair)
        if not good or not all(abs(v) <= MAX_UNITS for v in pair):
            raise GlyphError(f"{field}.{n}", f"expected [x, y], each {MAX_UNITS:g} at most")
        points.append([float(v) for v in pair])
    median = np.array(points)
    kept = np.concatenate(([True], np.linalg.norm(np.diff(median, axis=0), axis=1) > 1e-9))
    if np.count_nonzero(kept) < 2:
        raise GlyphError(field, "expected two different points")
    return median[kept]


def paths_of(glyph: Glyph, patch: Patch, step_mm: float) -> list[StrokePath]:
    """The medians of a character, resampled, each with its distance to the stroke's outline."""
    out: list[StrokePath] = []
    for stroke in glyph.strokes:
        points = resampled(patch.to_mm(stroke.median), step_mm)
        out.append(StrokePath(points, distance_to(patch.to_mm(stroke.polyline()), points)))
    return out


def reference(glyph: Glyph, patch: Patch, size_px: int = SIZE_PX) -> Image:
    """The image of a character's outlines, with the exact coverage of each stroke."""
    image = np.zeros((size_px, size_px), np.float32)
    for stroke in glyph.strokes:
        points = patch.to_mm(stroke.arcs)[None]
        loop = Outline(points, np.ones(points.shape[:2]))
        drawn = coverage(loop, (0.0, patch.side_mm), size_px=size_px, px_mm=patch.side_mm / size_px)
        image = np.maximum(image, drawn[0])
    return image


def distance_to(loop: Floats, points: Floats) -> Floats:
    """The distance of (N, 2) points to a closed polyline (M, 2), (N,); 0 outside it."""
    start, end = loop, np.roll(loop, -1, axis=0)
    side = end - start
    off = points[:, None] - start
    share = np.clip(np.sum(off * side, axis=2) / np.maximum(np.sum(side**2, axis=1), 1e-18), 0, 1)
    nearest = np.linalg.norm(off - share[..., None] * side, axis=2).min(axis=1)
    y = points[:, 1:]
    crosses = (start[:, 1] > y) != (end[:, 1] > y)
    rise = np.where(side[:, 1] == 0, 1.0, side[:, 1])
    left = points[:, :1] < start[:, 0] + (y - start[:, 1]) / rise * side[:, 0]
    inside = np.count_nonzero(crosses & left, axis=1) % 2 == 1
    return np.where(inside, nearest, 0.0)


def parse_csv(text: str, patch: Patch, step_mm: float) -> list[StrokePath]:
    """The paths of a CSV; raises GlyphError, which names line and column."""
    if len(text) > MAX_TRAJECTORY_CHARS:
        raise GlyphError("", f"is longer than {MAX_TRAJECTORY_CHARS} characters")
    rows = csv.DictReader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True)
    strokes: dict[int, list[_Point]] = {}
    number, last = 0, None
    try:
        header = [name.strip() for name in rows.fieldnames or []]
        rows.fieldnames = header
        for name in COLUMNS:
            if name not in header:
                raise GlyphError("line 1", f"has no column {name}")
        if extra := [name for name in header if name not in (*COLUMNS, "stroke")]:
            raise GlyphError("line 1", f"unknown column {extra[0][:40]!r}; known: stroke, {', '.join(COLUMNS)}")
        for row in rows:
            where = f"line {rows.line_num}"
            if None in row or None in row.values():
                raise GlyphError(where, f"expected {len(header)} values, one for each column")
            if row.get("stroke") != last or not strokes:
                number, last = number + 1, row.get("stroke")
            strokes.setdefault(number, []).append(_point([row[name] for name in COLUMNS], where, patch))
    except csv.Error as error:
        raise GlyphError(f"line {rows.line_num}", f"is not CSV: {error}") from None
    return _paths(list(strokes.values()), step_mm)


def parse_json(text: str, patch: Patch, step_mm: float) -> list[StrokePath]:
    """The paths of a JSON trajectory; raises GlyphError, which names stroke and point."""
    data = _json_of(text, MAX_TRAJECTORY_CHARS)
    table = cast("dict[str, Any]", data) if isinstance(data, dict) else {}
    strokes: list[list[_Point]] = []
    for k, stroke in enumerate(_list(table.get("strokes"), "strokes", 1, MAX_DRAWN_STROKES, "strokes")):
        strokes.append([])
        for n, point in enumerate(_list(stroke, f"strokes.{k}", 1, MAX_POINTS, "points")):
            where = f"strokes.{k}.{n}"
            if not isinstance(point, list) or len(cast("list[Any]", point)) != len(COLUMNS):
                raise GlyphError(where, f"expected [{', '.join(COLUMNS)}]")
            strokes[-1].append(_point(cast("list[Any]", point), where, patch))
    return _paths(strokes, step_mm)


_Point = tuple[float, float, float]


def _point(values: list[Any], where: str, patch: Patch) -> _Point:
    out: list[float] = []
    for name, value in zip(COLUMNS, values, strict=True):
        low, high = (0.0, MAX_WIDTH_MM) if name == "width_mm" else (0.0, patch.side_mm)
        try:
            number = math.nan if isinstance(value, bool) or "_" in str(value) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not low <= number <= high:
            raise GlyphError(f"{where}: {name}", f"must be a number, {low:g} to {high:g} (given: {value!r:.40})")
        out.append(number)
    return out[0], out[1], out[2]


def _paths(strokes: list[list[_Point]], step_mm: float) -> list[StrokePath]:
    if not strokes:
        raise GlyphError("", "holds no stroke")
    if len(strokes) > MAX_DRAWN_STROKES or sum(map(len, strokes)) > MAX_POINTS:
        raise GlyphError("", f"more than {MAX_DRAWN_STROKES} strokes or {MAX_POINTS} points")
    out: list[StrokePath] = []
    for k, stroke in enumerate(strokes):
        points = np.array(stroke)
        along = lengths_along(points[:, :2])
        if along[-1] < 2 * step_mm:
            raise GlyphError(f"stroke {k + 1}", f"is {along[-1]:.3g} mm long, expected at least {2 * step_mm:g} mm")
        even = resampled(points[:, :2], step_mm)
        at = np.linspace(0, along[-1], len(even))
        out.append(StrokePath(even, 0.5 * np.interp(at, along, points[:, 2])))
    return out


def swept(paths: Sequence[StrokePath], side_mm: float, size_px: int = SIZE_PX) -> Image:
    """The image of discs along paths: the intended look of a user's trajectory with widths."""
    x, y = np.meshgrid(*grid(side_mm, size_px))
    image = np.zeros((size_px, size_px))
    for path in paths:
        along = lengths_along(path.points)
        at = np.linspace(0, along[-1], max(2, math.ceil(along[-1] / (0.25 * side_mm / size_px))))
        for cx, cy, r in zip(*(np.interp(at, along, v) for v in (*path.points.T, path.half_width_mm)), strict=True):
            edge = (r - np.hypot(x - cx, y - cy)) * size_px / side_mm
            image = np.maximum(image, np.clip(0.5 + edge, 0, 1))
    return image.astype(np.float32)


def _json_of(text: str, most_chars: int) -> Any:
    if len(text) > most_chars:
        raise GlyphError("", f"is longer than {most_chars} characters")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise GlyphError("", f"is not JSON: {str(error).splitlines()[0][:100]}") from None


def _list(value: object, field: str, least: int, most: int, what: str = "entries") -> list[Any]:
    if not isinstance(value, list) or not least <= len(cast("list[Any]", value)) <= most:
        raise GlyphError(field, f"expected a list of {least} to {most} {what}")
    return cast("list[Any]", value)
