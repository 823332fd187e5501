"""What one row of a protocol's side file holds, and what may stand in it."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from collect.rig.config_file import Config

DeepMm = Annotated[float, Field(gt=0.0, le=100.0)]
TiltDeg = Annotated[float, Field(ge=0.0, le=30.0)]
DwellS = Annotated[float, Field(ge=0.0, le=60.0)]
InCellMm = Annotated[float, Field(ge=0.0, le=500.0)]
PathDepthMm = Annotated[float, Field(ge=-20.0, le=100.0)]
HeadingDeg = Annotated[float, Field(ge=-720.0, le=720.0)]

TrajectoryPoint = tuple[InCellMm, InCellMm, PathDepthMm, TiltDeg, HeadingDeg]
"""x, y in the figure's cell; depth below the touch height, negative above the paper; tilt; where the ferrule leans to,
counter-clockwise from the sheet's x."""

LEAST_APART_MM = 1.0
"""ARCS reads a line shorter than this as a turn on the spot, with speeds in rad/s, and halts for it."""
MAX_ID = 100


def stroke_id_problem(ident: str) -> str:
    """Why a stroke may not be called so; empty where it may. It names files, and it is shown on terminals."""
    if not 1 <= len(ident) <= MAX_ID:
        return f"a name has 1 to {MAX_ID} characters"
    if not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident) or ident[0] in ".-~":
        return 'a name has no spaces, control characters, slashes or any of < > : " | ? *, and begins with no . - ~'
    return ""


class PressRow(Config):
    """One press of a list."""

    height_mm: DeepMm
    tilt_deg: TiltDeg = 0.0
    dwell_s: DwellS | None = None
    """Left out, the protocol's."""
    stroke_id: str | None = None
    """Left out, it is made of the row's number, H and alpha."""

    @field_validator("stroke_id")
    @classmethod
    def _name(cls, ident: str | None) -> str | None:
        if ident is not None and (problem := stroke_id_problem(ident)):
            raise ValueError(problem)
        return ident


class ReplayRow(Config):
    """What an inversion says of one stroke."""

    stroke_id: str
    """The id that it had."""
    height_mm: DeepMm
    tilt_deg: TiltDeg

    @field_validator("stroke_id")
    @classmethod
    def _name(cls, ident: str) -> str:
        if problem := stroke_id_problem(ident):
            raise ValueError(problem)
        return ident


class PointRow(Config):
    """One point of a trajectory as a row of a CSV."""

    x_mm: InCellMm
    y_mm: InCellMm
    height_mm: PathDepthMm
    tilt_deg: TiltDeg = 0.0
    heading_deg: HeadingDeg = 0.0

    @property
    def point(self) -> TrajectoryPoint:
        """The row as the protocol keeps it."""
        return self.x_mm, self.y_mm, self.height_mm, self.tilt_deg, self.heading_deg


class DrawnStroke(Config):
    """One stroke: down at the first point, along the others without a halt, up at the last."""

    file: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """CSV with the columns `x_mm`, `y_mm`, `height_mm` and, as one likes, `tilt_deg` and `heading_deg`."""
    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=2, max_length=1000)]
    """[x_mm, y_mm, height_mm, tilt_deg, heading_deg] each. Read from `file` where one is named."""

    @model_validator(mode="after")
    def _drawn(self) -> DrawnStroke:
        for number, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False), 2):
            if math.dist(a[:3], b[:3]) < LEAST_APART_MM:
                raise ValueError(f"point {number} lies less than {LEAST_APART_MM:g} mm from the one before")
        if max(point[2] for point in self.points) <= 0.0:
            raise ValueError("no point lies below the touch height: nothing would be drawn")
        return self

    @property
    def deepest(self) -> TrajectoryPoint:
        """The first of its deepest points."""
        return max(self.points, key=lambda point: point[2])
