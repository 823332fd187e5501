"""The kinds of protocol: `grid`, `few-strokes`, `list`, `replay` press; `write` draws; `calibration` only touches."""

from __future__ import annotations

import math
import random
from abc import abstractmethod
from typing import Annotated, ClassVar, Literal, Self

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
    check_count,
    check_distinct,
    numbered,
    shuffled,
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


class _DesignConfig(ProtocolBase):
    """Presses of a grid of depths and tilts."""

    depths_field: ClassVar[str] = "depths_mm"

    depths_mm: Annotated[list[DeepMm], Field(min_length=1, max_length=100)]
    """Depths H below the touch height."""
    tilts_deg: Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
    """Tilts alpha from the paper's normal."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        check_distinct("depths_mm", self.depths_mm)
        check_distinct("tilts_deg", self.tilts_deg)
        return self

    def _press(self, condition: Condition, repeat: int) -> Planned:
        name = f"H{condition.depth_mm:g}-a{condition.tilt_deg:g}-r{repeat:02d}"
        return Planned(name, condition, repeat, dwell_s=self.dwell_s)


class GridConfig(_DesignConfig):
    """The paper's grid: every depth at every tilt, `repeats` times, in an order shuffled by `seed`.

    Where the layout of the sheet is known, the order also spreads each (H, alpha) over the sheet (`protocols.plan`).
    """

    kind: Literal["grid"]
    repeats: Repeats = 10
    """Rounds: each holds every (H, alpha) once."""
    seed: Seed = 1
    """Seed of the order."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        check_count(len(self.depths_mm) * len(self.tilts_deg) * self.repeats)
        return self

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every cell of the grid `repeats` times; each round holds all cells once, in its own shuffled order.

        Rounds keep a drift of ink or paper from looking like an effect of H or alpha. With a layout, each (H, alpha) is
        also spread over the sheet, which does the same for unevenness of the paper or of the camera's view.
        """
        rng = random.Random(self.seed)
        conditions = [Condition(h, a) for h in self.depths_mm for a in self.tilts_deg]
        rounds: list[list[Planned]] = []
        for repeat in range(1, self.repeats + 1):
            rng.shuffle(conditions)
            rounds.append([self._press(condition, repeat) for condition in conditions])
        return numbered(rounds, self.seed, layout)


class FewStrokesConfig(_DesignConfig):
    """A few presses of a grid that tell most about a brush: each (H, alpha) as far as possible from those before it."""

    kind: Literal["few-strokes"]
    strokes: Annotated[int, Field(ge=1, le=MAX_STROKES)] = 9
    """Number of presses. After every (H, alpha) once, the same order begins again."""

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """The presses in the order of the design, which does not depend on the sheet."""
        order = [Condition(h, a) for h, a in spread_out(self.depths_mm, self.tilts_deg)]
        rounds = math.ceil(self.strokes / len(order))
        presses = [self._press(condition, repeat) for repeat in range(1, rounds + 1) for condition in order]
        return numbered([presses[: self.strokes]], None, None)


class _TableConfig(ProtocolBase):
    """Presses one by one, from a CSV next to `protocol.toml` or written out in it as `presses`."""

    file: FileName | None = None
    """CSV with a column for each field of a press."""
    repeats: Repeats = 1
    """Rounds: each holds every press once."""
    seed: Seed | None = None
    """Shuffles each round; if left out, the order is that of the list."""
    dwell_s: DwellS = 0.2
    """Time at full depth of presses that have no `dwell_s` of their own."""

    @model_validator(mode="after")
    def _named_apart(self) -> Self:
        check_count(len(self.round(1)) * self.repeats)
        check_distinct("presses", [stroke.stroke_id for stroke in self.planned()])
        return self

    @abstractmethod
    def round(self, repeat: int) -> list[Planned]:
        """The presses of round `repeat`, counted from 1, in the order of the list."""

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every press `repeats` times, in rounds; shuffled and balanced over the sheet where there is a seed."""
        rounds = [self.round(repeat) for repeat in range(1, self.repeats + 1)]
        return numbered(shuffled(rounds, self.seed), self.seed, layout)


class PressRow(Config):
    """One press of a list."""

    depth_mm: DeepMm
    tilt_deg: TiltDeg = 0.0
    dwell_s: DwellS | None = None
    """Time at full depth; if left out, the protocol's."""
    stroke_id: StrokeId | None = None
    """If left out, it is made from the row's number, H and alpha."""


class ListConfig(_TableConfig):
    """Presses one by one. The CSV has a column `depth_mm` and optionally `tilt_deg`, `dwell_s` and `stroke_id`."""

    row: ClassVar[type[BaseModel] | None] = PressRow

    kind: Literal["list"]
    presses: Annotated[tuple[PressRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """The presses. Read from `file` where one is named."""

    def round(self, repeat: int) -> list[Planned]:
        """The presses of round `repeat`, counted from 1.

        A press without an id is named after its number in the list, H and alpha, as `003-H15-a5-r01`. A given id gets
        `-r02` and so on from the second round on.
        """
        ending, strokes = f"-r{repeat:02d}", list[Planned]()
        for number, row in enumerate(self.presses, 1):
            name = f"{number:03d}-H{row.depth_mm:g}-a{row.tilt_deg:g}{ending}"
            if row.stroke_id is not None:
                name = row.stroke_id + (ending if repeat > 1 else "")
            dwell_s = self.dwell_s if row.dwell_s is None else row.dwell_s
            strokes.append(Planned(name, Condition(row.depth_mm, row.tilt_deg), repeat, dwell_s=dwell_s))
        return strokes


class ReplayRow(Config):
    """One stroke as an inversion recovered it."""

    stroke_id: StrokeId
    """Its id in the original session."""
    depth_mm: DeepMm
    tilt_deg: TiltDeg


class ReplayConfig(_TableConfig):
    """Press again what an inversion recovered from the images of an earlier session, to compare mark with mark.

    The CSV has the columns `stroke_id`, `depth_mm` and `tilt_deg`; any other column is ignored, and named in
    `ignored_columns`.
    """

    row: ClassVar[type[BaseModel] | None] = ReplayRow
    ignores_columns: ClassVar[bool] = True

    kind: Literal["replay"]
    of: StrokeId
    """Id of the session that the strokes are from."""
    presses: Annotated[tuple[ReplayRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """The presses, under the ids that the strokes had. Read from `file` where one is named."""
    ignored_columns: tuple[str, ...] = ()
    """Columns of `file` that are not used."""

    def round(self, repeat: int) -> list[Planned]:
        """The presses of round `repeat`: `H13-a5-r02` pressed again is `H13-a5-r02~1`, then `~2` and so on.

        An id may hold a `~` but not begin with one: everything before the last `~` is the original's id, which is also
        `again_of` in the step's parameters.
        """
        return [
            Planned(
                f"{row.stroke_id}~{repeat}",
                Condition(row.depth_mm, row.tilt_deg),
                repeat,
                dwell_s=self.dwell_s,
                again_of=row.stroke_id,
            )
            for row in self.presses
        ]


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
    def _marks(self) -> Self:
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

    name: Annotated[StrokeId, Field(max_length=60)]
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
    def _on_the_cell(self) -> Self:
        check_distinct("figures", [figure.name for figure in self.figures])
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
        rounds = [
            [self._drawn(figure, repeat, number) for number, figure in enumerate(self.figures)]
            for repeat in range(1, self.repeats + 1)
        ]
        return [stroke for strokes in shuffled(rounds, self.seed) for stroke in strokes]

    def _drawn(self, figure: Figure, repeat: int, number: int) -> Planned:
        """Figure `number`, from 0, of round `repeat`, from 1."""
        _, _, depth_mm, tilt_deg, _ = max((stroke.deepest for stroke in figure.strokes), key=lambda point: point[2])
        drawn = Drawn(
            [list(stroke.points) for stroke in figure.strokes],
            self.cell_mm,
            self.speed_mm_s,
            self.blend_mm,
            self.dip_every_strokes,
        )
        index = (repeat - 1) * len(self.figures) + number
        return Planned(f"{figure.name}-r{repeat:02d}", Condition(depth_mm, tilt_deg), repeat, index, drawn=drawn)


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
    def _apart(self) -> Self:
        if self.board_every is not None:
            raise ValueError("board_every counts strokes, and this protocol has none: use board_views")
        if self.wait_after_dip_s is not None:
            raise ValueError("wait_after_dip_s: this protocol has no dips")
        check_distinct("touches_mm", self.touches_mm)
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
