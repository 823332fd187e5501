"""`brushloop write plan`: reads what is to be written, makes and refines its trajectories, and writes the plan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from brushloop.calibrate.artefact import load_artefact, made_by
from brushloop.calibrate.commands import PlanRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written, read_bounded
from brushloop.calibrate.report import BLUE, picture_grid, save_picture
from brushloop.calibrate.writing import Figure, Plan, PlannedBy, as_medians, as_points, code_points, write_plan
from brushloop.calibrate.writing.learn import FootprintArtefact
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.characters.glyph import CHARACTERS, parse_csv, parse_glyph, paths_of, reference, swept
from brushloop.model.characters.plan import Image, Patch, Reach, covered, drawn, first_lead, lead
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
MAX_FIGURES = 20
MOST_TILT_DEG = 30.0


def plan(request: PlanRequest, _progress: Progress = unseen) -> Written:
    """Plan each character of a text, or a trajectory file, and write protocol, plan and picture.

    Raises `CalibrationError` that names option, or file and field.
    """
    check_writable(request.out)
    fitted = load_artefact(request.footprint, FootprintArtefact) if request.footprint is not None else None
    limits = {name: getattr(request, name) for name in PlannedBy.model_fields if name != "footprint"}
    by = PlannedBy(**limits, footprint=None if fitted is None else fitted.footprint().values)
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
    wanted = read_wanted(request.what, request.data, patch)
    if fitted is None:
        drawing, label, simulated = model, model.label, "CCD-BSM, marks laid over each other along the way"
    else:
        drawing, label = fitted.footprint(), "fitted footprint"
        simulated = f"the footprint fitted to {fitted.session_id}, {fitted.source}"
    planned = [planned_figure(figure, drawing, reach, patch, tilt_deg, request.steps) for figure in wanted]
    request.out.mkdir(parents=True, exist_ok=True)
    draw(planned, patch.side_mm, request.out / PICTURE)
    figures = tuple(figure for figure, _ in planned)
    record = Plan(model=label, planned_by=by, cell_mm=patch.side_mm, software=made_by(), figures=figures)
    protocol = write_plan(record, request.repeats, request.out)
    return Written(protocol, (*_said(planned, simulated), str(protocol), str(request.out / PICTURE)))


def _said(planned: Sequence[tuple[Figure, Image]], simulated: str) -> Iterator[str]:
    yield f"simulated by {simulated}: not ink"
    for figure, first in planned:
        points = sum(len(stroke) for stroke in figure.commanded)
        scores = f"first plan {_likeness(figure, first)}; refined {_likeness(figure, figure.simulated)}"
        yield f"{figure.name}: {len(figure.commanded)} strokes, {points} points, ink = 1: {scores}"


def _likeness(figure: Figure, image: Image) -> str:
    return f"CSIM {csim(figure.wanted, image):.4f}, SSIM {ssim(figure.wanted, image):.4f}"


def planned_figure(
    figure: Figure, drawing: StrokeModel | Footprint, reach: Reach, patch: Patch, tilt_deg: float, steps: int
) -> tuple[Figure, Image]:
    """The figure with its trajectories, and the (128, 128) image of the first plan of them.

    With a stroke model, its presses are laid over each other along the way, refined in so many steps; with a
    footprint, the ink that it drags follows the figure.
    """
    side_mm, wanted = patch.side_mm, figure.wanted
    if isinstance(drawing, Footprint):
        first = first_lead(figure.paths, drawing, reach, side_mm, tilt_deg)
        footprints = [drawing] * len(first)
        strokes = lead(footprints, first, wanted, side_mm, reach)
        images = [covered(drawn(footprints, each, side_mm, len(wanted)), side_mm) for each in (first, strokes)]
    else:
        first = [trajectory(path, drawing, reach, patch, tilt_deg) for path in figure.paths]
        refined = refine(drawing, first, wanted, side_mm, reach, steps)
        strokes = [reach.spaced(np.round(reach.within(stroke, side_mm), 3)) for stroke in refined]
        images = [written(drawing, each, side_mm) for each in (first, strokes)]
    return figure.model_copy(update={"commanded": as_points(strokes), "simulated": images[1]}), images[0]


def read_wanted(what: str, data: Path | None, patch: Patch) -> list[Figure]:
    """Read the figures to write. Raises `CalibrationError` that names file and field."""
    if what.lower().endswith(".csv") and len(what) > len(".csv"):
        figures = [_drawn_by_hand(Path(what), patch)]
    elif not 1 <= len(what) <= MAX_FIGURES or not what.isprintable() or any(c.isspace() for c in what):
        raise CalibrationError("character", f"expected 1 to {MAX_FIGURES} characters, or a .csv trajectory")
    elif len(set(what)) != len(what):
        raise CalibrationError("character", "the same character twice: the protocol's `repeats` writes it again")
    else:
        figures = [_character(name, data, patch) for name in what]
    for figure in figures:
        if not figure.wanted.any():
            raise CalibrationError(figure.name, "has no width anywhere: nothing would be written")
    return figures


def _drawn_by_hand(path: Path, patch: Patch) -> Figure:
    try:
        paths = parse_csv(read_bounded(path).decode(), patch, STEP_MM)
    except ValueError as error:
        raise CalibrationError(str(path), str(error)) from None
    name = "".join(c if c.isalnum() or c in "-_" else "-" for c in path.stem)[:50].strip("-") or "figure"
    return Figure(name=name, source=path.name, medians=as_medians(paths), wanted=swept(paths, patch.side_mm))


def _character(name: str, data: Path | None, patch: Patch) -> Figure:
    """A character of a data set that has a file for each, or one of those that are shipped."""
    folder = data or CHARACTERS
    path = folder / f"{name}.json"
    if data is None and not path.exists():
        shipped = " ".join(sorted(file.stem for file in folder.glob("*.json")))
        raise CalibrationError(
            f"character {name!r}", f"is not shipped ({shipped}): --data names a folder of hanzi-writer-data that has it"
        )
    try:
        strokes = parse_glyph(read_bounded(path).decode())
    except ValueError as error:
        raise CalibrationError(str(path), str(error)) from None
    source = SHIPPED_SOURCE if data is None else data.name
    medians = as_medians(paths_of(strokes, patch, STEP_MM))
    return Figure(name=name, source=source, medians=medians, wanted=reference(strokes, patch))


def draw(planned: Sequence[tuple[Figure, Image]], side_mm: float, path: Path) -> None:
    """Draw a row per figure: wanted, first plan, refined plan, and the tip's trajectory over the wanted ink."""
    picture, rows = picture_grid(len(planned), 4, (12.0, 3.4 * len(planned)))
    extent = (0.0, side_mm, 0.0, side_mm)
    for (figure, first), axes in zip(planned, rows, strict=True):
        parts = (
            (figure.wanted, f"wanted: {code_points(figure.name)}"),
            (first, f"first plan, simulated: {_likeness(figure, first)}"),
            (figure.simulated, f"refined, simulated: {_likeness(figure, figure.simulated)}"),
            (0.25 * figure.wanted, "trajectory, with its depths"),
        )
        for axis, (image, title) in zip(axes, parts, strict=True):
            axis.imshow(1 - image, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.tick_params(labelsize=7)
        for stroke in figure.strokes:
            axes[3].plot(stroke[:, 0], stroke[:, 1], "-", color=BLUE, lw=0.8)
            axes[3].scatter(stroke[:, 0], stroke[:, 1], s=0.4 * stroke[:, 2], color=BLUE, zorder=3)
        axes[0].set_ylabel("mm", fontsize=7)
    save_picture(picture, path)
