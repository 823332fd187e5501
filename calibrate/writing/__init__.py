"""The files of a plan: plan.json with everything that later commands need, and the protocol that draws it."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PlainSerializer, PlainValidator, ValidationError

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare import SIZE_PX, Image
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.report import write_files
from brushloop.calibrate.session import OpenSession
from brushloop.model.characters.plan import Reach, StrokePath
from brushloop.model.drag import NAMES
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.messages import decode_gray, encode_png
from brushloop.sessions.records import Header

FILE, PROTOCOL = "plan.json", "protocol-write.toml"
"""Names of the files of a plan; the protocol is written last: if it exists, so does the other."""
MAX_PLAN_BYTES = 4 * 1024 * 1024
Number = Annotated[float, Field(allow_inf_nan=False)]
Points = tuple[tuple[tuple[Number, Number, Number, Number, Number], ...], ...]
"""[stroke][point] of x, y, depth, tilt, heading, as in the protocol."""
Medians = tuple[tuple[tuple[Number, Number, Number], ...], ...]
"""[stroke][point] of x, y and half width in mm."""
Floats = NDArray[np.float64]


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


class Round(Frozen):
    """What one round of learning found: the mean of its writings against the wanted image, mm, binary, ink = 1."""

    csim_percent: Number
    lost_percent: dict[str, Number]
    """Phase -> wrong pixels (missing or too much) there, in percent of the wanted ink."""


class Figure(Frozen):
    """What is written on one patch: a character or a drawing, as it is wanted, and as it is planned."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    source: str
    """Font or file that the wanted image comes from."""
    commanded: Points = ()
    """Where the arm goes; empty before it is planned."""
    wanted: Picture = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    simulated: Picture = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    """The ink as the planning model draws it."""
    medians: Medians = ()
    """What the phases follow from; empty for practice strokes."""
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

    def figure(self, name: str) -> Figure | None:
        """The figure of that name."""
        return next((figure for figure in self.figures if figure.name == name), None)


def load_plan(path: Path) -> Plan:
    """Read plan.json, or the one in a plan's folder. Raises `CalibrationError`."""
    path = path / FILE if path.is_dir() else path
    try:
        return Plan.model_validate_json(read_bounded(path, MAX_PLAN_BYTES))
    except ValidationError as error:
        raise invalid(str(path), error) from None


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


def check_drawn_from(plan: Plan, session: OpenSession) -> None:
    """Check that the session's protocol drew the plan. Raises `CalibrationError` otherwise."""
    where, cell_mm = str(session.recording.path), session.strokes[0].cell_mm
    for name, strokes in recorded_figures(session.header).items():
        figure = plan.figure(name)
        if figure is None or figure.commanded != as_points(strokes):
            raise CalibrationError(where, f"{name!r} was not drawn from this plan")
    if cell_mm is not None and cell_mm[2:] != (plan.cell_mm, plan.cell_mm):
        raise CalibrationError(where, f"has cells of {cell_mm[2]:g} x {cell_mm[3]:g} mm, the plan {plan.cell_mm:g} mm")


def code_points(name: str) -> str:
    """A name with code points for Chinese characters, since most machines have no font that shows them."""
    return " ".join(f"U+{ord(c):04X}" if ord(c) > 0x2E7F else c for c in name)


def as_points(strokes: Sequence[Floats]) -> Points:
    """Convert trajectories (N, 5) to points, rounded like the protocol to 0.001."""
    rounded = (np.round(stroke, 3).tolist() for stroke in strokes)
    return tuple(tuple((x, y, depth, tilt, heading) for x, y, depth, tilt, heading in stroke) for stroke in rounded)


def as_medians(paths: Sequence[StrokePath]) -> Medians:
    """Convert paths with their half widths."""
    arrays = (np.column_stack((path.points, path.half_width_mm)).tolist() for path in paths)
    return tuple(tuple((x, y, half) for x, y, half in array) for array in arrays)
