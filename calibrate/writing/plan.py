"""`brushloop write plan`: reads what is to be written, makes and refines its trajectories, and writes the plan."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

from brushloop.calibrate.artefact import load_artefact, made_by
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.report import BLUE, Written, picture_grid, save_picture
from brushloop.calibrate.writing.learn import FootprintArtefact
from brushloop.calibrate.writing.record import (
    FigureRecord,
    PlannedBy,
    PlanRecord,
    as_points,
    code_points,
    encoded,
    write_plan,
)
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.characters.glyph import parse_csv, parse_glyph, paths_of, reference, swept
from brushloop.model.characters.plan import Floats, Image, Patch, Reach, StrokePath, covered, drawn, first_lead, lead
from brushloop.model.characters.presses import refine, trajectory, written
from brushloop.model.drag import Footprint
from brushloop.model.similarity import csim, ssim
from brushloop.model.strokes import StrokeModel, stroke_model
from brushloop.sessions.disk import check_writable
from brushloop.sessions.terminal import Progress, unseen

PICTURE = "plan.png"
SHIPPED_SOURCE = "hanzi-writer-data 2.0.1, from Make Me a Hanzi; outlines of Arphic PL fonts, ARPHIC PUBLIC LICENSE"
STEP_MM = 2.0
"""Approximate distance of neighbouring points."""
TILT_DEG = 5.0
"""The initial tilt; refinement may change it within reach."""
MAX_FILE_BYTES = 64 * 1024 * 1024
"""makemeahanzi's file has a size of 30 MB."""
MAX_FIGURES = 20
MOST_TILT_DEG = 30.0


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Which characters are planned, and how."""

    what: str
    """Characters, or a .csv trajectory."""
    out: Path
    by: PlannedBy = field(default_factory=PlannedBy)
    data: Path | None = None
    """Folder of hanzi-writer files, or makemeahanzi's graphics.txt."""
    footprint: Path | None = None
    """Result of `write fit`: the plan leads the brush by it; replaces the stroke model and `steps`."""
    cell_mm: float = 70.0
    steps: int = 60
    """Steps of refinement; 0 keeps the first plan."""
    repeats: int = 1


@dataclass(frozen=True, slots=True)
class Wanted:
    """A figure to write: its name, its paths with half widths, and the image they should produce."""

    name: str
    source: str
    paths: list[StrokePath]
    image: Image


@dataclass(frozen=True, slots=True)
class PlannedFigure:
    """One figure: trajectories (N, 5) in order, and the model's image before and after refinement."""

    wanted: Wanted
    strokes: list[Floats]
    first: Image
    simulated: Image

    def scores(self) -> str:
        """CSIM and SSIM of the first plan, then of the refined one, against the wanted image."""
        image, (before, after) = self.wanted.image, (self.first, self.simulated)
        return (
            f"CSIM {csim(image, before):.4f} -> {csim(image, after):.4f}, "
            f"SSIM {ssim(image, before):.4f} -> {ssim(image, after):.4f}"
        )

    def record(self) -> FigureRecord:
        """The figure as plan.json holds it."""
        wanted = self.wanted
        medians = (np.column_stack((path.points, path.half_width_mm)).round(4).tolist() for path in wanted.paths)
        return FigureRecord(
            name=wanted.name,
            source=wanted.source,
            commanded=as_points(self.strokes),
            wanted_png=encoded(wanted.image),
            simulated_png=encoded(self.simulated),
            medians=tuple(tuple((x, y, half) for x, y, half in median) for median in medians),
        )


def plan(request: PlanRequest, _progress: Progress = unseen) -> Written:
    """Plan each character of a text, or a trajectory file, and write protocol, plan and picture.

    Raises `CalibrationError` that names option, or file and field.
    """
    check_writable(request.out)
    fitted = load_artefact(request.footprint, FootprintArtefact) if request.footprint is not None else None
    by = request.by if fitted is None else request.by.model_copy(update={"footprint": fitted.footprint().values})
    low, high = by.tilt_range_deg
    tilt_deg = min(max(TILT_DEG, low), high)
    try:
        if high > MOST_TILT_DEG or by.depth_range_mm[0] <= 0:
            raise ValueError(f"tilts end at {MOST_TILT_DEG:g} deg, depths begin above 0 mm")
        reach, patch = by.reach, Patch(request.cell_mm)
        model = stroke_model("ccd-bsm", Brush(by.radius_mm, by.length_mm))
        model.profile(by.depth_range_mm[1], high)
    except (ValueError, DomainError) as error:
        raise CalibrationError("write plan", str(error)) from None
    each = read_wanted(request.what, request.data, patch)
    if fitted is None:
        label, simulated = model.label, "CCD-BSM, marks laid over each other along the way"
        figures = [pressed(wanted, model, reach, patch, tilt_deg, request.steps) for wanted in each]
    else:
        label, simulated = "fitted footprint", f"the footprint fitted to {fitted.session_id}, {fitted.source}"
        figures = [led(wanted, fitted.footprint(), reach, patch, tilt_deg) for wanted in each]
    request.out.mkdir(parents=True, exist_ok=True)
    draw(figures, patch.side_mm, request.out / PICTURE)
    records = tuple(figure.record() for figure in figures)
    record = PlanRecord(model=label, planned_by=by, cell_mm=patch.side_mm, software=made_by(), figures=records)
    protocol = write_plan(record, request.repeats, request.out)
    return Written(protocol, (*_said(figures, simulated), str(protocol), str(request.out / PICTURE)))


def _said(figures: list[PlannedFigure], simulated: str) -> Iterator[str]:
    yield f"simulated by {simulated}: not ink"
    for figure in figures:
        points = sum(len(stroke) for stroke in figure.strokes)
        yield f"{figure.wanted.name}: {len(figure.strokes)} strokes, {points} points, ink = 1: {figure.scores()}"


def pressed(
    wanted: Wanted, model: StrokeModel, reach: Reach, patch: Patch, tilt_deg: float, steps: int
) -> PlannedFigure:
    """Plan a figure as presses that are laid over each other along the way."""
    side_mm = patch.side_mm
    first = [trajectory(path, model, reach, patch, tilt_deg) for path in wanted.paths]
    refined = refine(model, first, wanted.image, side_mm, reach, steps)
    strokes = [reach.spaced(np.round(reach.within(stroke, side_mm), 3)) for stroke in refined]
    return PlannedFigure(wanted, strokes, *(written(model, each, side_mm) for each in (first, strokes)))


def led(wanted: Wanted, footprint: Footprint, reach: Reach, patch: Patch, tilt_deg: float) -> PlannedFigure:
    """Plan a figure so that the ink of a dragged footprint follows it."""
    side_mm, size_px = patch.side_mm, len(wanted.image)
    first = first_lead(wanted.paths, footprint, reach, side_mm, tilt_deg)
    footprints = [footprint] * len(first)
    strokes = lead(footprints, first, wanted.image, side_mm, reach)
    images = (covered(drawn(footprints, each, side_mm, size_px), side_mm) for each in (first, strokes))
    return PlannedFigure(wanted, strokes, *images)


def read_wanted(what: str, data: Path | None, patch: Patch) -> list[Wanted]:
    """Read the figures to write. Raises `CalibrationError` that names file and field."""
    if what.lower().endswith(".csv") and len(what) > len(".csv"):
        each = [_drawn_by_hand(Path(what), patch)]
    elif not 1 <= len(what) <= MAX_FIGURES or not what.isprintable() or any(c.isspace() for c in what):
        raise CalibrationError("character", f"expected 1 to {MAX_FIGURES} characters, or a .csv trajectory")
    elif len(set(what)) != len(what):
        raise CalibrationError("character", "the same character twice: the protocol's `repeats` writes it again")
    else:
        each = [_character(name, data, patch) for name in what]
    for wanted in each:
        if not wanted.image.any():
            raise CalibrationError(wanted.name, "has no width anywhere: nothing would be written")
    return each


def _drawn_by_hand(path: Path, patch: Patch) -> Wanted:
    try:
        paths = parse_csv(_text(path), patch, STEP_MM)
    except ValueError as error:
        raise CalibrationError(str(path), str(error)) from None
    name = "".join(c if c.isalnum() or c in "-_" else "-" for c in path.stem)[:50].strip("-") or "figure"
    return Wanted(name, path.name, paths, swept(paths, patch.side_mm))


def _character(name: str, data: Path | None, patch: Patch) -> Wanted:
    if data is None:
        where, text = _shipped(name)
    elif data.is_dir():
        where, text = str(data / f"{name}.json"), _text(data / f"{name}.json")
    else:
        where, text = str(data), _line_of(data, name)
    try:
        strokes = parse_glyph(text)
    except ValueError as error:
        raise CalibrationError(where, str(error)) from None
    source = SHIPPED_SOURCE if data is None else data.name
    return Wanted(name, source, paths_of(strokes, patch, STEP_MM), reference(strokes, patch))


def _shipped(name: str) -> tuple[str, str]:
    folder = files("brushloop.model.characters") / "data"
    known = sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))
    if name not in known:
        raise CalibrationError(
            f"character {name!r}", f"is not shipped ({' '.join(known)}): name the full data set with --data"
        )
    return f"{name}.json", (folder / f"{name}.json").read_text("utf-8")


def _line_of(data: Path, name: str) -> str:
    """The line of a character in makemeahanzi's graphics.txt, a JSON object a line."""
    for line in _text(data).splitlines():
        try:
            if name in line and json.loads(line)["character"] == name:
                return line
        except (ValueError, KeyError, TypeError, RecursionError):
            raise CalibrationError(str(data), "is neither a folder nor a graphics.txt") from None
    raise CalibrationError(str(data), f"holds no character {name!r}")


def _text(path: Path) -> str:
    try:
        return read_bounded(path, MAX_FILE_BYTES).decode("utf-8")
    except UnicodeDecodeError:
        raise CalibrationError(str(path), "is no UTF-8 text") from None


def draw(figures: list[PlannedFigure], side_mm: float, path: Path) -> None:
    """Draw a row per figure: wanted, first plan, refined plan, and the tip's trajectory over the wanted ink."""
    picture, rows = picture_grid(len(figures), 4, (12.0, 3.4 * len(figures)))
    extent = (0.0, side_mm, 0.0, side_mm)
    for figure, axes in zip(figures, rows, strict=True):
        image = figure.wanted.image
        titles = (
            f"wanted: {code_points(figure.wanted.name)}",
            f"first plan, simulated: CSIM {csim(image, figure.first):.4f}, SSIM {ssim(image, figure.first):.4f}",
            f"refined, simulated: CSIM {csim(image, figure.simulated):.4f}, SSIM {ssim(image, figure.simulated):.4f}",
            "trajectory, with its depths",
        )
        images = (image, figure.first, figure.simulated, 0.25 * image)
        for axis, shown, title in zip(axes, images, titles, strict=True):
            axis.imshow(1 - shown, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.tick_params(labelsize=7)
        for stroke in figure.strokes:
            axes[3].plot(stroke[:, 0], stroke[:, 1], "-", color=BLUE, lw=0.8)
            axes[3].scatter(stroke[:, 0], stroke[:, 1], s=0.4 * stroke[:, 2], color=BLUE, zorder=3)
        axes[0].set_ylabel("mm", fontsize=7)
    save_picture(picture, path)
