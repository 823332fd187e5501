"""What `plan.json` holds: where each figure leads the brush, the wanted and the simulated image, and what was learned.

Nothing here needs torch, so that a rig's computer can read a plan.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from brushloop.calibrate.compare.place import SIZE_PX, Image
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.messages import decode_gray

FILE, PROTOCOL = "plan.json", "protocol-write.toml"
"""Names of the files of a plan; the protocol is written last."""
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
    depth_range_mm: tuple[Number, Number]
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
    """Written by an earlier version, and not used."""
    settled: bool = False
    """Whether a further round is not expected to help: `commanded` is then the best that was written."""

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


class PlanRecord(BaseModel):
    """A plan."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: str
    """Label of the stroke model that planned and drew."""
    planned_by: PlannedBy
    cell_mm: Number
    software: str
    figures: Annotated[tuple[FigureRecord, ...], Field(min_length=1, max_length=1000)]

    def figure(self, name: str) -> FigureRecord | None:
        """The figure of that name."""
        return next((figure for figure in self.figures if figure.name == name), None)


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


def points_digest(strokes: Sequence[Any]) -> str:
    """SHA-256 of trajectories [stroke][point][x, y, height, tilt, heading], rounded like the protocol to 0.001."""
    rounded = [[[round(float(value), 3) + 0.0 for value in point] for point in stroke] for stroke in strokes]
    return hashlib.sha256(json.dumps(rounded, separators=(",", ":")).encode()).hexdigest()


def _decoded(text: str, where: str) -> Image:
    try:
        gray = decode_gray(base64.b64decode(text, validate=True), where)
    except (binascii.Error, ValueError, SessionDamaged):
        raise CalibrationError(FILE, f"{where} is not a picture") from None
    if gray.shape != (SIZE_PX, SIZE_PX):
        raise CalibrationError(FILE, f"{where} is {gray.shape[1]} x {gray.shape[0]} px, not {SIZE_PX} x {SIZE_PX}")
    return (1.0 - gray.astype(np.float32) / 255.0).astype(np.float32)
