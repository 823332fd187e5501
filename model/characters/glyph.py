"""Parse a character of hanzi-writer or makemeahanzi: an outline and a median for each stroke. Reads no files.

Font units: 1024 per side, x to the right, y upward from -124 at the bottom to 900 at the top. The data is not trusted:
sizes are bounded, and an error is one line.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SIDE_UNITS, FOOT_UNITS = 1024.0, -124.0
MAX_CHARS = 256 * 1024
MAX_STROKES, MAX_MEDIAN, MAX_SEGMENTS = 64, 256, 1024
MAX_UNITS = 4096.0
_CUBIC_PIECES = 8
_TOKEN = re.compile(r"\s*,?\s*(?:([A-Za-z])|([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?))")
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
    data = json_of(text, MAX_CHARS)
    if not isinstance(data, dict):
        raise GlyphError("", "is not a JSON object")
    table = cast("dict[str, Any]", data)
    paths, medians = (_list(table, key, 1, MAX_STROKES) for key in ("strokes", "medians"))
    if len(paths) != len(medians):
        raise GlyphError("medians", f"{len(medians)} for {len(paths)} strokes")
    strokes: list[GlyphStroke] = []
    for k, (path, median) in enumerate(zip(paths, medians, strict=True)):
        if not isinstance(path, str):
            raise GlyphError(f"strokes.{k}", "is not text")
        strokes.append(GlyphStroke(parse_path(path, f"strokes.{k}"), _median(median, f"medians.{k}")))
    return Glyph(name, tuple(strokes))


def json_of(text: str, most_chars: int) -> Any:
    """Decode a JSON text of at most `most_chars` characters; raises GlyphError."""
    if len(text) > most_chars:
        raise GlyphError("", f"is longer than {most_chars} characters")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise GlyphError("", f"is not JSON: {str(error).splitlines()[0][:100]}") from None


def parse_path(path: str, field: str) -> Floats:
    """Parse a closed SVG path of absolute M, L, Q, C and Z into arcs (K, 3, 2); raises GlyphError."""
    arcs: list[Floats] = []
    at = begin = np.zeros(2)
    for letter, numbers in _commands(path, field):
        points = np.array(numbers, np.float64).reshape(-1, 2)
        if letter == "M":
            if arcs:
                raise GlyphError(field, "has more than one loop")
            at = begin = points[0]
            continue
        if letter == "Z":
            points, letter = begin[None], "L"
        if letter == "L":
            if np.allclose(at, points[0]):
                continue
            arcs.append(np.stack((at, 0.5 * (at + points[0]), points[0])))
        elif letter == "Q":
            arcs.append(np.stack((at, *points)))
        else:
            arcs.extend(_cubic(np.stack((at, *points))))
        at = points[-1]
        if len(arcs) > MAX_SEGMENTS:
            raise GlyphError(field, f"has more than {MAX_SEGMENTS} pieces")
    if len(arcs) < 2:
        raise GlyphError(field, "encloses nothing")
    if not np.allclose(at, begin):
        arcs.append(np.stack((at, 0.5 * (at + begin), begin)))
    loop = np.stack(arcs)
    corners = GlyphStroke(loop, loop[:, 0]).polyline(4)
    following = np.roll(corners, -1, axis=0)
    area = 0.5 * float(np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]))
    if abs(area) < 1.0:
        raise GlyphError(field, "encloses nothing")
    return loop if area > 0 else np.ascontiguousarray(loop[::-1, ::-1])


def _commands(path: str, field: str) -> list[tuple[str, list[float]]]:
    out: list[tuple[str, list[float]]] = []
    at, letter, numbers = 0, "", list[float]()
    path = path.strip()
    while at < len(path):
        token = _TOKEN.match(path, at)
        if token is None:
            raise GlyphError(field, f"is not a path at character {at + 1}: {path[at : at + 12]!r}")
        at = token.end()
        if token[1] is not None:
            if numbers:
                raise GlyphError(field, f"{letter} takes {_TAKES[letter]} numbers at a time")
            letter = token[1]
            if letter not in _TAKES or (letter == "M") != (not out):
                raise GlyphError(field, f"{letter} at character {at}: expected M first, then L, Q, C or Z")
            if letter == "Z":
                out.append((letter, []))
            continue
        value = float(token[2])
        if not letter or letter == "Z" or not abs(value) <= MAX_UNITS:
            raise GlyphError(field, f"number {token[2][:20]} at character {at}: expected {MAX_UNITS:g} at most")
        numbers.append(value)
        if len(numbers) == _TAKES[letter]:
            out.append((letter, numbers))
            numbers = []
            letter = "L" if letter == "M" else letter  # further pairs after M are lines, as in SVG
        if len(out) > MAX_SEGMENTS:
            raise GlyphError(field, f"has more than {MAX_SEGMENTS} pieces")
    if numbers:
        raise GlyphError(field, f"{letter} takes {_TAKES[letter]} numbers at a time")
    return out


def _cubic(nodes: Floats) -> list[Floats]:
    """Approximate a cubic curve by parabolas, each through three of its points."""
    t = np.linspace(0, 1, 2 * _CUBIC_PIECES + 1)[:, None]
    p, q, r, s = nodes
    on = (1 - t) ** 3 * p + 3 * t * (1 - t) ** 2 * q + 3 * t**2 * (1 - t) * r + t**3 * s
    start, middle, end = on[:-1:2], on[1::2], on[2::2]
    return list(np.stack((start, 2 * middle - 0.5 * (start + end), end), axis=1))


def _median(given: object, field: str) -> Floats:
    if not isinstance(given, list) or not 2 <= len(cast("list[Any]", given)) <= MAX_MEDIAN:
        raise GlyphError(field, f"expected 2 to {MAX_MEDIAN} points")
    points: list[list[float]] = []
    for n, point in enumerate(cast("list[Any]", given)):
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


def _list(table: dict[str, Any], key: str, least: int, most: int) -> list[Any]:
    value = table.get(key)
    if not isinstance(value, list) or not least <= len(cast("list[Any]", value)) <= most:
        raise GlyphError(key, f"expected a list of {least} to {most}")
    return cast("list[Any]", value)
