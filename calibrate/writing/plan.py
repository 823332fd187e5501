"""Plans the writing of characters: reads them, makes and refines their trajectories, and scores the simulated image."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.score import csim, ssim
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.model.characters.brush import Reach
from brushloop.model.characters.glyph import MAX_CHARS, Glyph, GlyphError, parse_glyph
from brushloop.model.characters.hand import parse_csv, parse_json
from brushloop.model.characters.ink import Image, reference, swept, written
from brushloop.model.characters.lead import covered, drawn, first_lead, lead
from brushloop.model.characters.plan import Cell, paths_of, trajectory
from brushloop.model.characters.plan import Path as Way
from brushloop.model.characters.refine import refine
from brushloop.model.drag import DragModel
from brushloop.model.footprint import Footprint
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
SHIPPED_SOURCE = "hanzi-writer-data 2.0.1, from Make Me a Hanzi; outlines of Arphic PL fonts, ARPHIC PUBLIC LICENSE"
MAX_FILE_BYTES = 4 * 1024 * 1024
MAX_GRAPHICS_BYTES = 64 * 1024 * 1024
"""makemeahanzi's file has a size of 30 MB."""
MAX_FIGURES = 20


@dataclass(frozen=True, slots=True)
class Settings:
    """How characters are written. `tilt_deg` is the initial tilt; refinement may change it within reach."""

    cell: Cell = field(default_factory=Cell)
    reach: Reach = field(default_factory=Reach)
    tilt_deg: float = 5.0
    step_mm: float = 2.0
    """Approximate distance of neighbouring points."""
    steps: int = 60
    """Steps of refinement; 0 keeps the first plan."""
    drag: DragModel | None = None
    """Draws travelling strokes with bristle lag; None superimposes presses."""
    footprint: Footprint | None = None
    """Leads the brush so that the ink of this footprint follows the character; replaces model, `steps` and `drag`."""


@dataclass(frozen=True, slots=True)
class FigureRequest:
    """A figure to write: its name, its paths with half widths, and the image they should produce."""

    name: str
    source: str
    ways: list[Way]
    image: Image


@dataclass(frozen=True, slots=True)
class PlannedFigure:
    """One figure: trajectories (N, 5) in order, the wanted image, and the model's image before and after refinement."""

    request: FigureRequest
    strokes: list[Floats]
    first: Image
    simulated: Image

    def scores(self) -> tuple[float, float, float, float]:
        """CSIM and SSIM of the first plan, then of the refined one, against the wanted image."""
        image = self.request.image
        return (
            csim(image, self.first),
            ssim(image, self.first),
            csim(image, self.simulated),
            ssim(image, self.simulated),
        )


def plan(what: str, data: Path | None, model: StrokeModel, settings: Settings) -> list[PlannedFigure]:
    """Plan each character of a text, or a trajectory file (.csv, .json). Raises `CalibrationError`."""
    return [_planned(request, model, settings) for request in read_requests(what, data, settings)]


def read_requests(what: str, data: Path | None, settings: Settings) -> list[FigureRequest]:
    """Read the figures to write. Raises `CalibrationError` that names file and field."""
    if what.lower().endswith((".csv", ".json")) and len(what) > len(".csv"):
        return [_hand(Path(what), settings)]
    if not 1 <= len(what) <= MAX_FIGURES or not what.isprintable() or any(c.isspace() for c in what):
        raise CalibrationError("character", f"expected 1 to {MAX_FIGURES} characters, or a .csv or .json trajectory")
    if len(set(what)) != len(what):
        raise CalibrationError("character", "the same character twice: the protocol's `repeats` writes it again")
    out: list[FigureRequest] = []
    for name in what:
        glyph = _shipped(name) if data is None else _from(data, name)
        ways = paths_of(glyph, settings.cell, settings.step_mm)
        out.append(
            FigureRequest(name, SHIPPED_SOURCE if data is None else data.name, ways, reference(glyph, settings.cell))
        )
    return out


def _planned(request: FigureRequest, model: StrokeModel, settings: Settings) -> PlannedFigure:
    reach, cell = settings.reach, settings.cell
    low, high = reach.tilt_deg
    if not low <= settings.tilt_deg <= high:
        raise CalibrationError("--tilt", f"{settings.tilt_deg:g} deg is outside {low:g} to {high:g}")
    if not request.image.any():
        raise CalibrationError(request.name, "has no width anywhere: nothing would be written")
    if settings.footprint is not None:
        return _led(request, settings.footprint, settings)
    first = [trajectory(way, model, reach, cell, settings.tilt_deg, settings.drag) for way in request.ways]
    better = refine(model, first, request.image, cell.side_mm, reach, settings.steps, drag=settings.drag)
    strokes = [reach.spaced(np.round(reach.within(stroke, cell.side_mm), 3)) for stroke in better.strokes]
    before, after = (written(model, one, cell.side_mm, drag=settings.drag) for one in (first, strokes))
    return PlannedFigure(request, strokes, before, after)


def _led(request: FigureRequest, footprint: Footprint, settings: Settings) -> PlannedFigure:
    reach, side_mm, size_px = settings.reach, settings.cell.side_mm, len(request.image)
    first = first_lead(request.ways, footprint, reach, side_mm, settings.tilt_deg)
    each = [footprint] * len(first)
    strokes = lead(each, first, request.image, side_mm, reach)
    before, after = (covered(drawn(each, one, side_mm, size_px), side_mm) for one in (first, strokes))
    return PlannedFigure(request, strokes, before, after)


def _hand(path: Path, settings: Settings) -> FigureRequest:
    text = _text(path, MAX_FILE_BYTES)
    parse: Callable[[str, Cell, float], list[Way]] = parse_csv if path.suffix.lower() == ".csv" else parse_json
    try:
        ways = parse(text, settings.cell, settings.step_mm)
    except GlyphError as error:
        raise CalibrationError(str(path), str(error)) from None
    name = "".join(c if c.isalnum() or c in "-_" else "-" for c in path.stem)[:50].strip("-") or "figure"
    return FigureRequest(name, path.name, ways, swept(ways, settings.cell.side_mm))


def _shipped(name: str) -> Glyph:
    folder = files("brushloop.model.characters") / "data"
    known = sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))
    if name not in known:
        raise CalibrationError(
            f"character {name!r}", f"is not shipped ({' '.join(known)}): name the full data set with --data"
        )
    return _parsed(f"{name}.json", (folder / f"{name}.json").read_text("utf-8"), name)


def _from(data: Path, name: str) -> Glyph:
    """Read from a folder of `字.json` files, one such file, or makemeahanzi's graphics.txt (a JSON object a line)."""
    if data.is_dir():
        path = data / f"{name}.json"
        return _parsed(str(path), _text(path, MAX_CHARS), name)
    if data.suffix == ".json":
        return _parsed(str(data), _text(data, MAX_CHARS), name)
    for line in _text(data, MAX_GRAPHICS_BYTES).splitlines():
        if name in line or f"\\u{ord(name):04x}" in line.lower():
            try:
                entry = json.loads(line)
            except (ValueError, RecursionError):
                raise CalibrationError(str(data), "is neither a folder, a .json nor a graphics.txt") from None
            if isinstance(entry, dict) and entry.get("character") == name:  # pyright: ignore[reportUnknownMemberType]
                return _parsed(str(data), line, name)
    raise CalibrationError(str(data), f"holds no character {name!r}")


def _parsed(where: str, text: str, name: str) -> Glyph:
    try:
        return parse_glyph(text, name)
    except GlyphError as error:
        raise CalibrationError(where, str(error)) from None


def _text(path: Path, most_bytes: int) -> str:
    try:
        return read_bounded(path, most_bytes).decode("utf-8")
    except UnicodeDecodeError:
        raise CalibrationError(str(path), "is no UTF-8 text") from None
