"""`write`: figures made of trajectories, each on its own paper patch."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from brushloop.collect.protocols.base import (
    FileName,
    ProtocolBase,
    Repeats,
    Seed,
    check_count,
    check_distinct,
    stroke_id_problem,
)
from brushloop.collect.protocols.plan import Planned, shuffled
from brushloop.collect.protocols.steps import (
    Drawn,
    HeadingDeg,
    InCellMm,
    PathDepthMm,
    TiltDeg,
    TrajectoryPoint,
)
from brushloop.collect.rig.config_file import Config
from brushloop.collect.rig.paper import Layout
from brushloop.sessions.records import Condition

MAX_POINTS = 10_000
"""Most points in all trajectories of one protocol together."""
LEAST_APART_MM = 1.0
"""ARCS reads a line shorter than this as a turn on the spot, with speeds in rad/s, and halts for it."""

CellMm = Annotated[float, Field(ge=10.0, le=500.0)]


class PointRow(Config):
    """One point of a trajectory as a row of a CSV."""

    x_mm: InCellMm
    y_mm: InCellMm
    depth_mm: PathDepthMm
    tilt_deg: TiltDeg = 0.0
    heading_deg: HeadingDeg = 0.0

    @property
    def point(self) -> TrajectoryPoint:
        """The row as a tuple, in the order of `points` in a protocol."""
        return self.x_mm, self.y_mm, self.depth_mm, self.tilt_deg, self.heading_deg


class DrawnStroke(Config):
    """One stroke: down at the first point, along the others without a halt, up at the last."""

    file: FileName | None = None
    """CSV with the columns `x_mm`, `y_mm`, `depth_mm` and optionally `tilt_deg` and `heading_deg`."""
    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=2, max_length=1000)]
    """Points [x_mm, y_mm, depth_mm, tilt_deg, heading_deg]. Read from `file` where one is named."""

    @model_validator(mode="after")
    def _drawn(self) -> DrawnStroke:
        for number, (a, b) in enumerate(zip(self.points, self.points[1:], strict=False), 2):
            if math.dist(a[:3], b[:3]) < LEAST_APART_MM:
                raise ValueError(f"point {number} is less than {LEAST_APART_MM:g} mm from the previous point")
        if max(point[2] for point in self.points) <= 0.0:
            raise ValueError("no point is below the touch height: nothing would be drawn")
        return self

    @property
    def deepest(self) -> TrajectoryPoint:
        """The first of its deepest points."""
        return max(self.points, key=lambda point: point[2])


class Figure(Config):
    """A character or a single drawn line: strokes that share one paper patch."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    """The stroke id is this name and the number of the repeat."""
    strokes: Annotated[tuple[DrawnStroke, ...], Field(min_length=1, max_length=100)]
    """The strokes, in the order of writing."""


class WriteConfig(ProtocolBase):
    """Trajectories to draw: x, y, depth, tilt and heading, in the frame of the figure's own paper patch."""

    depths_field: ClassVar[str] = "figures"

    kind: Literal["write"]
    cell_mm: tuple[CellMm, CellMm]
    """Width and height of the patch for one figure. Its lower left corner is the origin, x along the sheet's x."""
    figures: Annotated[tuple[Figure, ...], Field(min_length=1, max_length=1000)]
    """The figures, in the order of writing."""
    repeats: Repeats = 1
    """Rounds: each holds every figure once."""
    seed: Seed | None = None
    """Shuffles each round; if left out, the order is that of the list."""
    speed_mm_s: Annotated[float, Field(ge=1.0, le=100.0)] = 20.0
    """Speed of the tip along the trajectory."""
    blend_mm: Annotated[float, Field(ge=1.0, le=20.0)] = 1.0
    """Distance from a point at which the tip may turn towards the next, so that the arm does not halt there. ARCS
    accepts no less than 1 mm."""
    dip_every_strokes: Annotated[int, Field(ge=0, le=100)] = 1
    """Dip again within a figure after this many strokes; 0 writes it with one dip."""

    @model_validator(mode="after")
    def _on_the_cell(self) -> WriteConfig:
        names = [figure.name for figure in self.figures]
        for name in names:
            if problem := stroke_id_problem(name):
                raise ValueError(f"figure {name!r}: {problem}")
        check_distinct("figures", names)
        check_count(len(self.figures) * self.repeats)
        points = 0
        for figure in self.figures:
            for number, stroke in enumerate(figure.strokes, 1):
                points += len(stroke.points)
                for x_mm, y_mm, *_ in stroke.points:
                    if not (0.0 <= x_mm <= self.cell_mm[0] and 0.0 <= y_mm <= self.cell_mm[1]):
                        raise ValueError(
                            f"figure {figure.name}, stroke {number}: the point [{x_mm:g}, {y_mm:g}] lies outside its "
                            f"patch of {self.cell_mm[0]:g} x {self.cell_mm[1]:g} mm"
                        )
        if points > MAX_POINTS:
            raise ValueError(f"{points} points in all, at most {MAX_POINTS}")
        return self

    @property
    def own_patch_mm(self) -> tuple[float, float]:
        """The patch of one figure."""
        return self.cell_mm

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every figure `repeats` times, in rounds. `layout` changes nothing: figures are not conditions of a design."""
        rounds: list[list[Planned]] = []
        index = 0
        for repeat in range(1, self.repeats + 1):
            strokes: list[Planned] = []
            for figure in self.figures:
                _, _, depth_mm, tilt_deg, _ = max((s.deepest for s in figure.strokes), key=lambda point: point[2])
                drawn = Drawn(
                    [list(stroke.points) for stroke in figure.strokes],
                    self.cell_mm,
                    self.speed_mm_s,
                    self.blend_mm,
                    self.dip_every_strokes,
                )
                name = f"{figure.name}-r{repeat:02d}"
                strokes.append(Planned(name, Condition(depth_mm, tilt_deg), repeat, index, drawn=drawn))
                index += 1
            rounds.append(strokes)
        return [stroke for strokes in shuffled(rounds, self.seed) for stroke in strokes]
