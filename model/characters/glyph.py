"""What is written, and its image: a character of hanzi-writer.

A character has an outline and a median for each stroke, in font units: 1024 per side, x to the right, y upward from
-124 at the bottom to 900 at the top. The data is not trusted: sizes are bounded, and an error is one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from fontTools.pens.recordingPen import RecordingPen
from fontTools.svgLib.path import parse_path as follow_svg
from pydantic import BaseModel, Field, ValidationError

from brushloop.model.characters.plan import Floats, Image, Patch, StrokePath, resampled
from brushloop.model.outline import Outline, through
from brushloop.model.raster import SIZE_PX, coverage

CHARACTERS = Path(__file__).parent / "data"
"""Folder of the characters that come with brushloop, a file for each, and of their licence."""
MAX_GLYPH_CHARS = 256 * 1024
MAX_SEGMENTS = 1024
MAX_UNITS = 4096.0
_CUBIC_PIECES = 8
_Unit = Annotated[float, Field(ge=-MAX_UNITS, le=MAX_UNITS)]


class _File(BaseModel):
    """A character's file; other keys are for other programs."""

    strokes: Annotated[list[str], Field(min_length=1, max_length=64)]
    medians: Annotated[
        list[Annotated[list[tuple[_Unit, _Unit]], Field(min_length=2, max_length=256)]],
        Field(min_length=1, max_length=64),
    ]


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


def parse_glyph(text: str) -> list[GlyphStroke]:
    """Parse a character from `{"strokes": [path, ...], "medians": [[[x, y], ...], ...]}`.

    The strokes are in the order of writing. Raises ValueError that names the field.
    """
    try:
        if len(text) > MAX_GLYPH_CHARS:
            raise ValueError(f"is longer than {MAX_GLYPH_CHARS} characters")
        file = _File.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise ValueError(f"{field}: {first['msg']}" if field else first["msg"]) from None
    if len(file.strokes) != len(file.medians):
        raise ValueError(f"medians: holds {len(file.medians)}, expected {len(file.strokes)}, one for each stroke")
    strokes: list[GlyphStroke] = []
    for k, (path, points) in enumerate(zip(file.strokes, file.medians, strict=True)):
        median = np.array(points)
        kept = np.concatenate(([True], np.linalg.norm(np.diff(median, axis=0), axis=1) > 1e-9))
        if np.count_nonzero(kept) < 2:
            raise ValueError(f"medians.{k}: expected two different points")
        strokes.append(GlyphStroke(parse_path(path, f"strokes.{k}"), median[kept]))
    return strokes


def parse_path(path: str, field: str) -> Floats:
    """Parse a closed SVG path into arcs (K, 3, 2), counter-clockwise. Raises ValueError that begins with `field`."""
    pen = RecordingPen()
    try:
        follow_svg(path, pen)
    except (ValueError, IndexError, ArithmeticError) as error:
        raise ValueError(f"{field}: not an SVG path: {str(error)[:60]}") from None
    moves: list[tuple[str, tuple[tuple[float, float], ...]]] = pen.value
    arcs, begin, at = list[Floats](), np.zeros(2), np.zeros(2)
    for name, points in moves:
        if name == "moveTo":
            begin = at = np.array(points[0])
            continue
        nodes = np.array([at, *(points or (begin,))])
        arcs += _parabolas(nodes)
        at = nodes[-1]
    if sum(name == "moveTo" for name, _ in moves) > 1 or len(arcs) > MAX_SEGMENTS:
        raise ValueError(f"{field}: expected one loop of at most {MAX_SEGMENTS} pieces")
    loop = np.array(arcs).reshape(-1, 3, 2)
    if not np.all(np.abs(loop) <= 2 * MAX_UNITS):
        raise ValueError(f"{field}: expected coordinates of at most {MAX_UNITS:g}")
    x, y = GlyphStroke(loop, loop[:, 0]).polyline(4).T
    area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    if abs(area) < 1.0:
        raise ValueError(f"{field}: encloses nothing")
    return loop if area > 0 else np.ascontiguousarray(loop[::-1, ::-1])


def _parabolas(nodes: Floats) -> list[Floats]:
    """A line, a parabola or a cubic curve of (2, 2), (3, 2) or (4, 2) nodes as parabolas: none, one or eight."""
    if len(nodes) == 2:
        return [] if np.allclose(*nodes) else [np.stack((nodes[0], nodes.mean(axis=0), nodes[1]))]
    if len(nodes) == 3:
        return [nodes]
    t = np.linspace(0, 1, 2 * _CUBIC_PIECES + 1)[:, None]
    p, q, r, s = nodes
    curve = (1 - t) ** 3 * p + 3 * t * (1 - t) ** 2 * q + 3 * t**2 * (1 - t) * r + t**3 * s
    return list(through(curve[None])[0])


def paths_of(strokes: Sequence[GlyphStroke], patch: Patch, step_mm: float) -> list[StrokePath]:
    """The medians of a character, resampled, each with its distance to the stroke's outline."""
    out: list[StrokePath] = []
    for stroke in strokes:
        points = resampled(patch.to_mm(stroke.median), step_mm)
        out.append(StrokePath(points, distance_to(patch.to_mm(stroke.polyline()), points)))
    return out


def reference(strokes: Sequence[GlyphStroke], patch: Patch, size_px: int = SIZE_PX) -> Image:
    """The image of a character's outlines, with the exact coverage of each stroke."""
    image = np.zeros((size_px, size_px), np.float32)
    for stroke in strokes:
        points = patch.to_mm(stroke.arcs)[None]
        loop = Outline(points, np.ones(points.shape[:2]))
        drawn = coverage(loop, (0.0, patch.side_mm), size_px=size_px, px_mm=patch.side_mm / size_px)
        image = np.maximum(image, drawn[0])
    return image


def distance_to(loop: Floats, points: Floats) -> Floats:
    """The distance of (N, 2) points to a closed polyline (M, 2), (N,); 0 outside it."""
    contour = np.ascontiguousarray(loop, np.float32)
    return np.array([max(0.0, cv2.pointPolygonTest(contour, (x, y), True)) for x, y in points.tolist()])
