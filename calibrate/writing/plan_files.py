"""The files of a plan: plan.json with images for a later comparison with ink, the protocol, and a picture."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibrate.compare.field import SIZE_PX, Image
from calibrate.errors import CalibrationError, invalid
from calibrate.files import read_bounded
from calibrate.report import write_files
from calibrate.writing.picture import draw
from model.characters.plan import Path as Way
from sessions.errors import SessionDamaged
from sessions.recording.messages import decode_gray, encode_png

if TYPE_CHECKING:
    from calibrate.writing.plan import PlannedFigure, Settings

FILE, PROTOCOL, PICTURE = "plan.json", "protocol-write.toml", "plan.png"
MAX_PLAN_BYTES = 4 * 1024 * 1024
Text = Annotated[str, Field(max_length=64 * 1024)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Points = tuple[tuple[tuple[Number, Number, Number, Number, Number], ...], ...]
"""[stroke][point] of x, y, height, tilt, heading, as in the protocol."""
Floats = NDArray[np.float64]


class PlannedBy(BaseModel):
    """The model and the brush's reach that a plan was made with."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: str
    """Name of the stroke model."""
    radius_mm: Number
    length_mm: Number
    lam: Number | None
    """None means pi."""
    height_range_mm: tuple[Number, Number]
    tilt_range_deg: tuple[Number, Number]
    turn_deg_mm: Number
    speed_mm_s: Number
    drag_fit: Annotated[str, Field(max_length=64)] = ""
    """Digest of the drag fit that images were drawn with; empty for superimposed presses."""
    footprint: Annotated[tuple[Number, ...], Field(max_length=64)] | None = None
    """Values of the fitted footprint (`model.footprint`) that the plan leads the brush by; None without one."""


class Round(BaseModel):
    """What one round of learning found: the mean of its writings against the wanted image, mm, binary, ink = 1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    csim_percent: Number
    lost_percent: dict[str, Number]
    """Phase -> wrong pixels (missing or too much) there, in percent of the wanted ink."""


class FigureRecord(BaseModel):
    """One planned figure."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=60)]
    source: Text
    """Font or file that the wanted image comes from."""
    commanded: Points
    """Where the arm goes."""
    intended: Points
    """What `commanded` was before learning moved its points; the same as `commanded` in plans of today."""
    wanted_png: Text
    """128 x 128 gray in base64, ink black, row 0 at the cell's far edge."""
    simulated_png: Text
    medians: tuple[tuple[tuple[Number, Number, Number], ...], ...] = ()
    """[stroke][point] of x, y and half width in mm: what the phases follow from; empty in older plans."""
    rounds: Annotated[tuple[Round, ...], Field(max_length=1000)] = ()
    """The rounds of learning so far, in order."""
    best: Points = ()
    """What was commanded in the best of them."""
    best_png: Text = ""
    """The mean ink of that round, as `wanted_png`; empty in older plans."""
    settled: bool = False
    """Whether a further round is not expected to help: `commanded` is then the best that was written."""

    @property
    def ways(self) -> list[Way]:
        """The medians as paths."""
        arrays = (np.array(one, np.float64) for one in self.medians)
        return [Way(one[:, :2], one[:, 2]) for one in arrays]

    @property
    def points_sha256(self) -> str:
        """Digest of the commanded points: a session drawn from other points belongs to another plan."""
        return points_digest(self.commanded)

    def wanted(self) -> Image:
        """(128, 128) ink from 0 to 1. Raises `CalibrationError`."""
        return _decoded(self.wanted_png, f"{self.name}: wanted_png")

    def simulated(self) -> Image:
        """(128, 128) ink from 0 to 1 as the planning model draws it. Raises `CalibrationError`."""
        return _decoded(self.simulated_png, f"{self.name}: simulated_png")

    def best_ink(self) -> Image:
        """(128, 128) mean ink of the best round from 0 to 1. Raises `CalibrationError`."""
        return _decoded(self.best_png, f"{self.name}: best_png")


class PlanRecord(BaseModel):
    """A plan."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: str
    """Label of the stroke model that planned and drew."""
    planned_by: PlannedBy
    cell_mm: float
    software: str
    figures: Annotated[tuple[FigureRecord, ...], Field(min_length=1, max_length=1000)]

    def figure(self, name: str) -> FigureRecord | None:
        """The figure of that name."""
        return next((figure for figure in self.figures if figure.name == name), None)


def figure_record(
    name: str,
    source: str,
    commanded: Sequence[Floats],
    intended: Sequence[Floats],
    *,
    wanted: Image,
    simulated: Image,
    ways: Sequence[Way] = (),
) -> FigureRecord:
    """Record of a planned figure: trajectories (N, 5), images (128, 128), medians with half widths."""
    return FigureRecord(
        name=name,
        source=source,
        commanded=as_points(commanded),
        intended=as_points(intended),
        wanted_png=encoded(wanted),
        simulated_png=encoded(simulated),
        medians=tuple(
            tuple(
                (round(x, 4), round(y, 4), round(half, 4))
                for (x, y), half in zip(way.points, way.half_width_mm, strict=True)
            )
            for way in ways
        ),
    )


def arrays(points: Points) -> list[Floats]:
    """Convert points to trajectories (N, 5)."""
    return [np.array(stroke, np.float64) for stroke in points]


def load_plan(path: Path) -> PlanRecord:
    """Read plan.json, or the one in a plan's folder. Raises `CalibrationError`."""
    path = path / FILE if path.is_dir() else path
    try:
        return PlanRecord.model_validate_json(read_bounded(path, MAX_PLAN_BYTES))
    except ValidationError as error:
        raise invalid(str(path), error) from None


def record_of(planned: PlannedFigure) -> FigureRecord:
    """Record of a figure as it was planned."""
    wanted = planned.request
    strokes, ways = planned.strokes, wanted.ways
    return figure_record(
        wanted.name, wanted.source, strokes, strokes, wanted=wanted.image, simulated=planned.simulated, ways=ways
    )


def write_plan(
    figures: list[PlannedFigure], settings: Settings, by: PlannedBy, label: str, repeats: int, out: Path
) -> Path:
    """Write picture, plan.json and protocol into a folder; returns the protocol's path. Raises OSError.

    `label` is the planning model's display name. The protocol is written last: if it exists, so do the others.
    """
    out.mkdir(parents=True, exist_ok=True)
    draw(figures, settings, out / PICTURE)
    record = PlanRecord(
        model=label,
        planned_by=by,
        cell_mm=settings.cell.side_mm,
        software=f"brushloop {version('brushloop')}",
        figures=tuple(record_of(one) for one in figures),
    )
    return write_record(record, repeats, out)


def write_record(record: PlanRecord, repeats: int, out: Path) -> Path:
    """Write plan.json, then the protocol that draws it; returns the protocol's path. Raises OSError."""
    write_files(out, {FILE: record.model_dump_json(indent=2) + "\n", PROTOCOL: write_toml(record, repeats)})
    return out / PROTOCOL


def write_toml(record: PlanRecord, repeats: int) -> str:
    """The `write` protocol."""
    side = record.cell_mm
    lines = [
        'kind = "write"',
        f"cell_mm = [{side!r}, {side!r}]",
        f"speed_mm_s = {record.planned_by.speed_mm_s!r}",
        "blend_mm = 1.0",
        f"repeats = {repeats}",
    ]
    for figure in record.figures:
        source = " ".join(figure.source.split())
        lines += ["", f"# From {json.dumps(source)}", "[[figures]]"]
        lines.append(f"name = {json.dumps(figure.name, ensure_ascii=False)}")
        for stroke in figure.commanded:
            lines += ["", "[[figures.strokes]]", "points = ["]
            lines += ["    [" + ", ".join(f"{value:.3f}" for value in point) + "]," for point in stroke]
            lines.append("]")
    return "\n".join(lines) + "\n"


def points_digest(strokes: Sequence[Any]) -> str:
    """SHA-256 of trajectories [stroke][point][x, y, height, tilt, heading], rounded like the protocol to 0.001."""
    rounded = [[[round(float(value), 3) + 0.0 for value in point] for point in stroke] for stroke in strokes]
    return hashlib.sha256(json.dumps(rounded, separators=(",", ":")).encode()).hexdigest()


def as_points(strokes: Sequence[Floats]) -> Points:
    """Convert trajectories (N, 5) to points, rounded like the protocol to 0.001."""
    rounded = (np.round(stroke, 3).tolist() for stroke in strokes)
    return tuple(tuple((x, y, height, tilt, heading) for x, y, height, tilt, heading in stroke) for stroke in rounded)


def encoded(ink: Image) -> str:
    """(128, 128) ink as a PNG in base64."""
    return base64.b64encode(encode_png(np.rint(255.0 * (1.0 - ink)).astype(np.uint8))).decode()


def _decoded(text: str, where: str) -> Image:
    try:
        gray = decode_gray(base64.b64decode(text, validate=True), where)
    except (binascii.Error, ValueError, SessionDamaged):
        raise CalibrationError(FILE, f"{where} is not a picture") from None
    if gray.shape != (SIZE_PX, SIZE_PX):
        raise CalibrationError(FILE, f"{where} is {gray.shape[1]} x {gray.shape[0]} px, not {SIZE_PX} x {SIZE_PX}")
    return (1.0 - gray.astype(np.float32) / 255.0).astype(np.float32)
