"""The kinds of protocol: `grid`, `few-strokes`, `list`, `replay` press; `write` draws; `calibration` only touches."""

from __future__ import annotations

import math
import random
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, Field, model_validator

from brushloop.calibrate.stats import spread_out
from brushloop.collect.protocols.plan import (
    MAX_STROKES,
    DeepMm,
    DwellS,
    FileName,
    Planned,
    ProtocolBase,
    Repeats,
    Seed,
    StrokeId,
    check_axes,
    check_count,
    check_distinct,
    numbered,
    shuffled,
    stroke_id_problem,
)
from brushloop.collect.protocols.steps import (
    BoardStep,
    Drawn,
    HeadingDeg,
    InCellMm,
    PathDepthMm,
    Protocol,
    TiltDeg,
    TouchStep,
    TrajectoryPoint,
    ZeroTouchStep,
)
from brushloop.collect.rig.config_file import Config, Finite
from brushloop.collect.rig.paper import Layout
from brushloop.sessions.records import Condition


class GridConfig(ProtocolBase):
    """The paper's grid: every depth at every tilt, `repeats` times, in an order shuffled by `seed`.

    Where the layout of the sheet is known, the order also spreads each (H, alpha) over the sheet (`protocols.plan`).
    """

    depths_field: ClassVar[str] = "depths_mm"

    kind: Literal["grid"]
    depths_mm: Annotated[list[DeepMm], Field(min_length=1, max_length=100)]
    """Depths H below the touch height."""
    tilts_deg: Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
    """Tilts alpha from the paper's normal."""
    repeats: Repeats = 10
    """Rounds: each holds every (H, alpha) once."""
    seed: Seed = 1
    """Seed of the order."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _distinct(self) -> GridConfig:
        check_axes(self.depths_mm, self.tilts_deg)
        check_count(len(self.depths_mm) * len(self.tilts_deg) * self.repeats)
        return self

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every cell of the grid `repeats` times; each round holds all cells once, in its own shuffled order.

        Rounds keep a drift of ink or paper from looking like an effect of H or alpha. With a layout, each (H, alpha) is
        also spread over the sheet, which does the same for unevenness of the paper or of the camera's view.
        """
        rng = random.Random(self.seed)
        cells = [(h, a) for h in self.depths_mm for a in self.tilts_deg]
        rounds: list[list[Planned]] = []
        for repeat in range(1, self.repeats + 1):
            rng.shuffle(cells)
            rounds.append(
                [
                    Planned(f"H{h:g}-a{a:g}-r{repeat:02d}", Condition(h, a), repeat, dwell_s=self.dwell_s)
                    for h, a in cells
                ]
            )
        return numbered(rounds, self.seed, layout)


class FewStrokesConfig(ProtocolBase):
    """A few presses of a grid that tell most about a brush: each (H, alpha) as far as possible from those before it."""

    depths_field: ClassVar[str] = "depths_mm"

    kind: Literal["few-strokes"]
    depths_mm: Annotated[list[DeepMm], Field(min_length=1, max_length=100)]
    """Depths H below the touch height."""
    tilts_deg: Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
    """Tilts alpha from the paper's normal."""
    strokes: Annotated[int, Field(ge=1, le=MAX_STROKES)] = 9
    """Number of presses. After every (H, alpha) once, the same order begins again."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _distinct(self) -> FewStrokesConfig:
        check_axes(self.depths_mm, self.tilts_deg)
        return self

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """The presses in the order of the design, which does not depend on the sheet."""
        order = spread_out(self.depths_mm, self.tilts_deg)
        return [
            Planned(f"H{h:g}-a{a:g}-r{repeat + 1:02d}", Condition(h, a), repeat + 1, number, dwell_s=self.dwell_s)
            for number in range(self.strokes)
            for repeat, (h, a) in [(number // len(order), order[number % len(order)])]
        ]


class PressRow(Config):
    """One press of a list."""

    depth_mm: DeepMm
    tilt_deg: TiltDeg = 0.0
    dwell_s: DwellS | None = None
    """Time at full depth; if left out, the protocol's."""
    stroke_id: StrokeId | None = None
    """If left out, it is made from the row's number, H and alpha."""


class ListConfig(ProtocolBase):
    """Presses one by one, from a CSV next to `protocol.toml` or written out in it."""

    row: ClassVar[type[BaseModel] | None] = PressRow

    kind: Literal["list"]
    file: FileName | None = None
    """CSV with a column `depth_mm` and optionally `tilt_deg`, `dwell_s` and `stroke_id`."""
    presses: Annotated[tuple[PressRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """The presses. Read from `file` where one is named."""
    repeats: Repeats = 1
    """Rounds: each holds every press once."""
    seed: Seed | None = None
    """Shuffles each round; if left out, the order is that of the list."""
    dwell_s: DwellS = 0.2
    """Time at full depth of presses that have no `dwell_s` of their own."""

    @model_validator(mode="after")
    def _named_apart(self) -> ListConfig:
        check_count(len(self.presses) * self.repeats)
        check_distinct("presses", [name for repeat in range(1, self.repeats + 1) for name in self.names(repeat)])
        return self

    def names(self, repeat: int) -> list[str]:
        """Stroke ids of round `repeat`, counted from 1.

        A press without an id is named after its number in the list, H and alpha, as `003-H15-a5-r01`. A given id gets
        `-r02` and so on from the second round on.
        """
        ending = f"-r{repeat:02d}"
        return [
            row.stroke_id + (ending if repeat > 1 else "")
            if row.stroke_id is not None
            else f"{number:03d}-H{row.depth_mm:g}-a{row.tilt_deg:g}{ending}"
            for number, row in enumerate(self.presses, 1)
        ]

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every press `repeats` times, in rounds; shuffled and balanced over the sheet where there is a seed."""
        rounds = [
            [
                Planned(
                    name,
                    Condition(row.depth_mm, row.tilt_deg),
                    repeat,
                    dwell_s=self.dwell_s if row.dwell_s is None else row.dwell_s,
                )
                for row, name in zip(self.presses, self.names(repeat), strict=True)
            ]
            for repeat in range(1, self.repeats + 1)
        ]
        return numbered(shuffled(rounds, self.seed), self.seed, layout)


class ReplayRow(Config):
    """One stroke as an inversion recovered it."""

    stroke_id: StrokeId
    """Its id in the original session."""
    depth_mm: DeepMm
    tilt_deg: TiltDeg


class ReplayConfig(ProtocolBase):
    """Press again what an inversion recovered from the images of an earlier session, to compare mark with mark."""

    row: ClassVar[type[BaseModel] | None] = ReplayRow
    ignores_columns: ClassVar[bool] = True

    kind: Literal["replay"]
    of: Annotated[str, Field(min_length=1, max_length=100)]
    """Id of the session that the strokes are from."""
    file: FileName | None = None
    """CSV with the columns `stroke_id`, `depth_mm` and `tilt_deg`; any other column is ignored and named in
    `ignored_columns`."""
    presses: Annotated[tuple[ReplayRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """The presses, under the ids that the strokes had. Read from `file` where one is named."""
    ignored_columns: tuple[str, ...] = ()
    """Columns of `file` that are not used."""
    repeats: Repeats = 1
    """How often each is pressed again; each round holds every stroke once."""
    seed: Seed | None = None
    """Shuffles each round; if left out, the order is that of the list."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _named_apart(self) -> ReplayConfig:
        if problem := stroke_id_problem(self.of):
            raise ValueError(f"of = {self.of!r}: {problem}")
        check_distinct("presses", [row.stroke_id for row in self.presses])
        check_count(len(self.presses) * self.repeats)
        return self

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every stroke `repeats` times. `H13-a5-r02` pressed again is `H13-a5-r02~1`, then `~2` and so on.

        An id may hold a `~` but not begin with one: everything before the last `~` is the original's id, which is also
        `again_of` in the step's parameters.
        """
        rounds = [
            [
                Planned(
                    f"{row.stroke_id}~{repeat}",
                    Condition(row.depth_mm, row.tilt_deg),
                    repeat,
                    dwell_s=self.dwell_s,
                    again_of=row.stroke_id,
                )
                for row in self.presses
            ]
            for repeat in range(1, self.repeats + 1)
        ]
        return numbered(shuffled(rounds, self.seed), self.seed, layout)


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


class CalibrationConfig(ProtocolBase):
    """Touches and views of the board, nothing else: no ink, no mark."""

    kind: Literal["calibration"]
    touches_mm: Annotated[tuple[tuple[Finite, Finite], ...], Field(max_length=200)] = ()
    """Points of the sheet to touch, x and y in the paper frame. Three that are not on a line give the sheet's slope."""
    rounds: Annotated[int, Field(ge=1, le=100)] = 1
    """How often all of them are touched: the spread of a point over the rounds shows how well a touch repeats."""
    board_views: Annotated[int, Field(ge=1, le=1000)] = 1
    """How often the board is photographed in each round."""

    @model_validator(mode="after")
    def _apart(self) -> CalibrationConfig:
        if self.board_every is not None:
            raise ValueError("board_every counts strokes, and this protocol has none: use board_views")
        if self.wait_after_dip_s is not None:
            raise ValueError("wait_after_dip_s: this protocol has no dips")
        if len(set(self.touches_mm)) != len(self.touches_mm):
            raise ValueError("touches_mm contains the same point twice: use rounds")
        check_count((len(self.touches_mm) + self.board_views) * self.rounds)
        return self

    def steps(self, layout: Layout | None = None) -> Protocol:
        """Zero touch, then in each round every touch and every view of the board."""
        yield ZeroTouchStep(0)
        touches = views = 0
        for _ in range(self.rounds):
            for x_mm, y_mm in self.touches_mm:
                yield TouchStep(touches, x_mm, y_mm)
                touches += 1
            for _ in range(self.board_views):
                yield BoardStep(views)
                views += 1
