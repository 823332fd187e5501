"""`brushloop write plan`: trajectories of what is to be written, refined, in a plan that later commands read.

plan.json holds everything that they need, the protocol draws it, and plan.png shows it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, PlainSerializer, PlainValidator, model_validator

from brushloop.calibrate.artefact import Frozen, SessionFit, checked_fields, made_by
from brushloop.calibrate.commands import PROTOCOL, PlanRequest
from brushloop.calibrate.compare import SIZE_PX, Image
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.report import BLUE, picture_grid, save_picture, write_files
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.characters.glyph import CHARACTERS, parse_glyph, paths_of, reference
from brushloop.model.characters.plan import Patch, Reach, StrokePath, covered, drawn, first_lead, lead
from brushloop.model.drag import NAMES, Floats, Footprint
from brushloop.model.similarity import csim, ssim
from brushloop.model.strokes import StrokeModel, stroke_model
from brushloop.sessions.disk import check_writable, read_bounded
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.messages import decode_gray, encode_png
from brushloop.sessions.records import Header
from brushloop.sessions.terminal import Progress, unseen

FILE = "plan.json"
"""Name of the file of a plan; its protocol is written last: if that exists, so does the plan."""
PICTURE = "plan.png"
SHIPPED_SOURCE = "hanzi-writer-data 2.0.1, from Make Me a Hanzi; outlines of Arphic PL fonts, ARPHIC PUBLIC LICENSE"
STEP_MM = 2.0
"""Approximate distance of neighbouring points."""
TILT_DEG = 5.0
"""The initial tilt, which refinement may change within reach; practice strokes keep it."""
MAX_FIGURES = 20
MOST_TILT_DEG = 30.0
MAX_PLAN_BYTES = 4 * 1024 * 1024
Number = Annotated[float, Field(allow_inf_nan=False)]
Points = tuple[tuple[tuple[Number, Number, Number, Number, Number], ...], ...]
"""[stroke][point] of x, y, depth, tilt, heading, as in the protocol."""


def _encoded(ink: Image) -> str:
    return base64.b64encode(encode_png(np.rint(255.0 * (1.0 - ink)).astype(np.uint8))).decode()


def _decoded(picture: Any) -> Image:
    if isinstance(picture, str):
        try:
            gray = decode_gray(base64.b64decode(picture, validate=True), "")
        except (ValueError, SessionDamaged):
            raise ValueError("is not a picture") from None
        picture = 1.0 - gray.astype(np.float32) / np.float32(255.0)
    if np.shape(picture) != (SIZE_PX, SIZE_PX):
        raise ValueError(f"is not a picture of {SIZE_PX} x {SIZE_PX} px")
    return picture


Picture = Annotated[Image, PlainValidator(_decoded), PlainSerializer(_encoded)]
"""(128, 128) ink from 0 to 1, row 0 at the patch's far edge; in the file a gray PNG in base64 with the ink black."""


class PlannedBy(Frozen):
    """The brush, and the limits of brush and arm, that a plan is made with."""

    radius_mm: Number = 6.0
    length_mm: Number = 48.0
    depth_range_mm: tuple[Number, Number] = (0.5, 20.0)
    tilt_range_deg: tuple[Number, Number] = (0.0, 10.0)
    speed_mm_s: Number = 15.0
    """Speed of the tip."""
    wrist_deg_s: Number = 180.0
    """Greatest speed of the wrist."""
    footprint: Annotated[tuple[Number, ...], Field(min_length=len(NAMES), max_length=len(NAMES))] | None = None
    """Values of the fitted footprint (`model.drag`) that the plan leads the brush by; None without one."""

    @property
    def reach(self) -> Reach:
        """The limits as trajectories keep them. Raises ValueError for ranges that make no sense."""
        return Reach(self.depth_range_mm, self.tilt_range_deg, turn_deg_mm=self.wrist_deg_s / self.speed_mm_s)


class FootprintArtefact(SessionFit):
    """A fitted footprint on disk. Equal inputs give an equal file."""

    FOLDER: ClassVar[str] = "footprint"

    values: dict[str, Annotated[float, Field(allow_inf_nan=False)]]
    images: int
    strokes: int
    csim_percent: float
    """Mean agreement with the ink that it was fitted to, ink = 1: an upper bound of what it predicts."""

    def footprint(self) -> Footprint:
        """The fitted footprint."""
        return Footprint(tuple(self.values[name] for name in NAMES))

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if set(self.values) != set(NAMES):
            raise ValueError("values: made by another version; fit the session again with `brushloop write fit`")
        return self


class Round(Frozen):
    """What one round of learning found: the mean of its writings against the wanted image, mm, binary, ink = 1."""

    csim_percent: Number
    lost_percent: dict[str, Number]
    """Phase -> wrong pixels (missing or too much) there, in percent of the wanted ink."""


class Figure(Frozen):
    """What is written on one patch: a character or practice strokes, as it is wanted, and as it is planned."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    source: str
    """Font or file that the wanted image comes from."""
    commanded: Points = ()
    """Where the arm goes; empty before it is planned."""
    wanted: Picture = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    simulated: Picture = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    """The ink as the planning model draws it."""
    medians: tuple[tuple[tuple[Number, Number, Number], ...], ...] = ()
    """[stroke][point] of x, y and half width in mm, which the phases follow from; empty for practice strokes."""
    rounds: Annotated[tuple[Round, ...], Field(max_length=1000)] = ()
    """The rounds of learning so far, in order."""
    best: Points = ()
    """What was commanded in the best of them."""
    settled: bool = False
    """Whether a further round is not expected to help: `commanded` is then the best that was written."""

    @property
    def strokes(self) -> list[Floats]:
        """The commanded trajectories, (N, 5) each."""
        return [np.array(stroke, np.float64) for stroke in self.commanded]

    @property
    def paths(self) -> list[StrokePath]:
        """The medians with their half widths."""
        arrays = (np.array(median, np.float64) for median in self.medians)
        return [StrokePath(median[:, :2], median[:, 2]) for median in arrays]


class Plan(Frozen):
    """The figures that a protocol writes, and how they were planned."""

    model: str
    """Label of the stroke model that planned and drew."""
    planned_by: PlannedBy
    cell_mm: Number
    software: str
    figures: Annotated[tuple[Figure, ...], Field(min_length=1, max_length=1000)]


def load_plan(path: Path) -> Plan:
    """Read plan.json, or the one in a plan's folder. Raises `CalibrationError`."""
    path = path / FILE if path.is_dir() else path
    with checked_fields(str(path)):
        return Plan.model_validate_json(read_bounded(path, MAX_PLAN_BYTES))


def write_plan(plan: Plan, repeats: int, out: Path) -> Path:
    """Write plan.json, then the protocol that draws it `repeats` times; returns the protocol's path. Raises OSError."""
    lines = [
        'kind = "write"',
        f"cell_mm = [{plan.cell_mm!r}, {plan.cell_mm!r}]",
        f"speed_mm_s = {plan.planned_by.speed_mm_s!r}",
        f"repeats = {repeats}",
    ]
    for figure in plan.figures:
        source = " ".join(figure.source.split())
        lines += ["", f"# From {json.dumps(source)}", "[[figures]]"]
        lines.append(f"name = {json.dumps(figure.name, ensure_ascii=False)}")
        for stroke in figure.commanded:
            lines += ["", "[[figures.strokes]]", "points = ["]
            lines += ["    [" + ", ".join(f"{value:.3f}" for value in point) + "]," for point in stroke]
            lines.append("]")
    write_files(out, {FILE: plan.model_dump_json(indent=2) + "\n", PROTOCOL: "\n".join(lines) + "\n"})
    return out / PROTOCOL


def recorded_figures(header: Header) -> dict[str, list[Floats]]:
    """The strokes, (N, 5) each, of every figure of a recorded protocol. Raises `CalibrationError` without any."""
    try:
        return {
            str(figure["name"]): [np.array(stroke["points"], np.float64).reshape(-1, 5) for stroke in figure["strokes"]]
            for figure in json.loads(header.protocol)["figures"]
        }
    except (ValueError, KeyError, TypeError, RecursionError):
        raise CalibrationError(header.session_id, "was not collected by a `write` protocol") from None


def code_points(name: str) -> str:
    """A name with code points for Chinese characters, since most machines have no font that shows them."""
    return " ".join(f"U+{ord(c):04X}" if ord(c) > 0x2E7F else c for c in name)


def as_points(strokes: Sequence[Floats]) -> Points:
    """Convert trajectories (N, 5) to points, rounded like the protocol to 0.001."""
    rounded = (np.round(stroke, 3).tolist() for stroke in strokes)
    return tuple(tuple((x, y, depth, tilt, heading) for x, y, depth, tilt, heading in stroke) for stroke in rounded)


def plan(request: PlanRequest, _progress: Progress = unseen) -> Written:
    """Plan each character of a text, and write protocol, plan and picture.

    Raises `CalibrationError` that names option, or file and field.
    """
    check_writable(request.out)
    fitted = FootprintArtefact.read(request.footprint) if request.footprint is not None else None
    limits = {name: getattr(request, name) for name in PlannedBy.model_fields if name != "footprint"}
    by = PlannedBy(**limits, footprint=None if fitted is None else fitted.footprint().values)
    low, high = by.tilt_range_deg
    tilt_deg = min(max(TILT_DEG, low), high)
    try:
        if high > MOST_TILT_DEG or by.depth_range_mm[0] <= 0:
            raise ValueError(f"tilts must be at most {MOST_TILT_DEG:g} deg, and depths above 0 mm")
        reach, patch = by.reach, Patch(request.cell_mm)
        model = stroke_model("ccd-bsm", Brush(by.radius_mm, by.length_mm))
        model.profile(by.depth_range_mm[1], high)
    except (ValueError, DomainError) as error:
        raise CalibrationError("write plan", str(error)) from None
    wanted = read_wanted(request.what, request.data, patch)
    if fitted is None:
        drawing, label, simulated = model, model.label, "CCD-BSM, whose marks are laid over each other along the path"
    else:
        drawing, label = fitted.footprint(), "fitted footprint"
        simulated = f"the footprint fitted to {fitted.session_id}, {fitted.source}"
    planned = [planned_figure(figure, drawing, reach, patch, tilt_deg, request.steps) for figure in wanted]
    request.out.mkdir(parents=True, exist_ok=True)
    draw(planned, patch.side_mm, request.out / PICTURE)
    figures = tuple(figure for figure, _ in planned)
    record = Plan(model=label, planned_by=by, cell_mm=patch.side_mm, software=made_by(), figures=figures)
    protocol = write_plan(record, request.repeats, request.out)
    said = [f"simulated without ink by {simulated}"]
    for figure, first in planned:
        points = sum(map(len, figure.commanded))
        scores = f"first plan {_likeness(figure, first)}; refined {_likeness(figure, figure.simulated)}"
        said.append(f"{figure.name}: {len(figure.commanded)} strokes, {points} points, ink = 1: {scores}")
    return Written(protocol, (*said, str(protocol), str(request.out / PICTURE)))


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
        from brushloop.model.characters.presses import refine, trajectory, written  # scipy is slow to import

        first = [trajectory(path, drawing, reach, patch, tilt_deg) for path in figure.paths]
        refined = refine(drawing, first, wanted, side_mm, reach, steps)
        strokes = [reach.spaced(np.round(reach.within(stroke, side_mm), 3)) for stroke in refined]
        images = [written(drawing, each, side_mm) for each in (first, strokes)]
    return figure.model_copy(update={"commanded": as_points(strokes), "simulated": images[1]}), images[0]


def read_wanted(what: str, data: Path | None, patch: Patch) -> list[Figure]:
    """Read the figures to write. Raises `CalibrationError` that names file and field."""
    if not 1 <= len(what) <= MAX_FIGURES or not what.isprintable() or any(c.isspace() for c in what):
        raise CalibrationError("character", f"expected 1 to {MAX_FIGURES} characters")
    if len(set(what)) != len(what):
        raise CalibrationError("character", "a character occurs twice: set the protocol's `repeats` to write it again")
    return [_character(name, data, patch) for name in what]


def _character(name: str, data: Path | None, patch: Patch) -> Figure:
    """A character of a data set that has a file for each, or one of those that are shipped."""
    folder = data or CHARACTERS
    path = folder / f"{name}.json"
    if data is None and not path.exists():
        shipped = " ".join(sorted(file.stem for file in folder.glob("*.json")))
        raise CalibrationError(
            f"character {name!r}", f"is not shipped (only {shipped}): give a folder of hanzi-writer-data by --data"
        )
    try:
        strokes = parse_glyph(read_bounded(path).decode())
    except ValueError as error:
        raise CalibrationError(str(path), str(error)) from None
    wanted = reference(strokes, patch)
    if not wanted.any():
        raise CalibrationError(name, "has no width anywhere: nothing would be written")
    source = SHIPPED_SOURCE if data is None else data.name
    paths = paths_of(strokes, patch, STEP_MM)
    medians = [np.column_stack((path.points, path.half_width_mm)).tolist() for path in paths]
    fields = {"name": name, "source": source, "medians": medians, "wanted": wanted}
    return Figure.model_validate(fields)


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
