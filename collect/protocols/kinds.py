"""The kinds of protocol: `grid`, `few-strokes` and `list` press; `write` draws.

A kind with rounds says what one round presses or draws; `RoundsConfig` makes the order of all rounds.
"""

from __future__ import annotations

import itertools
import math
import random
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Literal, Self, TypeVar, cast

from pydantic import AfterValidator, AliasChoices, BaseModel, Field, ValidationInfo, model_validator

from brushloop.collect.protocols.steps import (
    BoardStep,
    Drawn,
    HeadingDeg,
    InCellMm,
    PathDepthMm,
    Planned,
    Protocol,
    SelfCheckStep,
    TiltDeg,
    TrajectoryPoint,
    ZeroTouchStep,
    takes,
)
from brushloop.collect.rig.config_file import Config
from brushloop.model.presses import spread_out
from brushloop.sessions.records import Condition

MAX_STROKES = 10_000
"""Most strokes of one protocol, repeats included: a month of pressing."""
MAX_POINTS = 10_000
"""Most points in all trajectories of one protocol together."""
MAX_STROKE_POINTS = 1000
MAX_ID = 100
LEAST_APART_MM = 1.0
"""ARCS reads a line shorter than this as a turn on the spot, with speeds in rad/s, and halts for it."""
EARLIER_DEPTH, EARLIER_DEPTHS = AliasChoices("depth_mm", "height_mm"), AliasChoices("depths_mm", "heights_mm")
"""Names of files that were written when the depth of a press was called a height."""

_Values = TypeVar("_Values", bound=Sequence[object])


def distinct(values: _Values) -> _Values:
    """Return the values. Raises ValueError if one occurs twice."""
    seen: set[object] = set()
    for value in values:
        if value in seen:
            raise ValueError(f"{value!r} occurs twice")
        seen.add(value)
    return values


def _stroke_id(ident: str) -> str:
    if not 1 <= len(ident) <= MAX_ID:
        raise ValueError(f"a name has 1 to {MAX_ID} characters")
    if not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident) or ident[0] in ".-~":
        what = 'a name may not contain spaces, control characters, slashes or < > : " | ? *, nor begin with . - or ~'
        raise ValueError(what)
    return ident


StrokeId = Annotated[str, AfterValidator(_stroke_id)]
"""A name that names files and is shown on terminals."""
DeepMm = Annotated[float, Field(gt=0.0, le=100.0)]
DwellS = Annotated[float, Field(ge=0.0, le=60.0)]
CellMm = Annotated[float, Field(ge=10.0, le=500.0)]
Repeats = Annotated[int, Field(ge=1, le=1000)]
Seed = Annotated[int, Field(ge=0)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]
Depths = Annotated[list[DeepMm], Field(min_length=1, max_length=100), AfterValidator(distinct)]
Tilts = Annotated[list[TiltDeg], Field(min_length=1, max_length=100), AfterValidator(distinct)]


class StrokesConfig(Config):
    """A protocol that presses or draws."""

    board_every: Annotated[int, Field(ge=1, le=MAX_STROKES)] | None = None
    """Photograph the board again after this many strokes, to see whether camera or sheet moved; if left out, only at
    the start."""

    @abstractmethod
    def planned(self) -> list[Planned]:
        """Every stroke exactly once, in order."""

    def steps(self, *, self_check: bool = False) -> Protocol:
        """Zero touch, board, self-check if wanted, then dip, press or draw, capture for each stroke."""
        yield ZeroTouchStep(0)
        yield BoardStep(0)
        if self_check:
            yield SelfCheckStep(0)
        for number, stroke in enumerate(self.planned()):
            if self.board_every is not None and number > 0 and number % self.board_every == 0:
                yield BoardStep(number // self.board_every)
            yield from takes(stroke)


class RoundsConfig(StrokesConfig):
    """A protocol that presses or draws the same in each of several rounds."""

    repeats: Repeats = 1
    """Rounds."""
    seed: Seed | None = None
    """Shuffles each round; if left out, the order is that of the round."""

    @abstractmethod
    def round(self, repeat: int) -> list[Planned]:
        """The strokes of round `repeat`, counted from 1, in the order of the file."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        strokes = len(self.round(1)) * self.repeats
        if strokes > MAX_STROKES:
            raise ValueError(f"{strokes} strokes with all repeats; at most {MAX_STROKES} are allowed")
        distinct([stroke.stroke_id for stroke in self.planned()])
        return self

    def planned(self) -> list[Planned]:
        """Every stroke of every round, each round shuffled with a seed.

        Rounds keep a drift of ink or paper from looking like an effect of H or alpha. Shuffling does the same for
        unevenness of the paper or of the camera's view.
        """
        rounds = [self.round(repeat) for repeat in range(1, self.repeats + 1)]
        if self.seed is not None:
            rng, order = random.Random(self.seed), list(range(len(rounds[0])))
            for k, strokes in enumerate(rounds):
                rng.shuffle(order)
                rounds[k] = [strokes[i] for i in order]
        strokes = itertools.chain.from_iterable(rounds)
        return [replace(stroke, index=index) for index, stroke in enumerate(strokes)]


# Presses of a grid


class _DesignConfig(StrokesConfig):
    """Presses of a grid of depths and tilts."""

    depths_mm: Depths = Field(validation_alias=EARLIER_DEPTHS)
    """Depths H below the touch height."""
    tilts_deg: Tilts
    """Tilts alpha from the paper's normal."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    def press(self, condition: Condition, repeat: int) -> Planned:
        """The press of a condition in round `repeat`, counted from 1."""
        name = f"H{condition.depth_mm:g}-a{condition.tilt_deg:g}-r{repeat:02d}"
        return Planned(name, condition, dwell_s=self.dwell_s)


class GridConfig(_DesignConfig, RoundsConfig):
    """The paper's grid: every depth at every tilt, `repeats` times, in an order shuffled by `seed`."""

    kind: Literal["grid"]
    repeats: Repeats = 10
    """Rounds: each holds every (H, alpha) once."""
    seed: Seed | None = 1
    """Seed of the order."""

    def round(self, repeat: int) -> list[Planned]:
        """Every condition of the grid."""
        conditions = [Condition(depth_mm, tilt_deg) for depth_mm in self.depths_mm for tilt_deg in self.tilts_deg]
        return [self.press(condition, repeat) for condition in conditions]


class FewStrokesConfig(_DesignConfig):
    """A few presses of a grid that tell most about a brush: each (H, alpha) as far as possible from those before it."""

    kind: Literal["few-strokes"]
    strokes: Annotated[int, Field(ge=1, le=MAX_STROKES)] = 9
    """Number of presses. After every (H, alpha) once, the same order begins again."""

    def planned(self) -> list[Planned]:
        """The presses in the order of the design."""
        order = [Condition(depth_mm, tilt_deg) for depth_mm, tilt_deg in spread_out(self.depths_mm, self.tilts_deg)]
        presses = [self.press(order[k % len(order)], k // len(order) + 1) for k in range(self.strokes)]
        return [replace(press, index=k) for k, press in enumerate(presses)]


# Presses one by one


def _with_rows(
    values: object,
    info: ValidationInfo,
    name: str,
    row: type[BaseModel],
    item: Callable[[BaseModel], object] = lambda row: row,
) -> object:
    """The fields of a table; where it names a CSV `file`, `name` holds an item for each row.

    `info.context` reads such a file. Without it, the table is one that a session keeps, and has its rows.
    """
    if info.context is None or not isinstance(values, dict) or "file" not in values:
        return cast("object", values)
    table = cast("dict[str, object]", values)
    if name in table:
        raise ValueError(f"{name} and file are both given: give only one of them")
    return table | {name: [item(each) for each in info.context(table["file"], row)]}


class PressRow(Config):
    """One press of a list."""

    depth_mm: DeepMm = Field(validation_alias=EARLIER_DEPTH)
    tilt_deg: TiltDeg = 0.0
    dwell_s: DwellS | None = None
    """Time at full depth; if left out, the protocol's."""
    stroke_id: StrokeId | None = None
    """If left out, it is made from the row's number, H and alpha."""


class ListConfig(RoundsConfig):
    """Presses one by one, from a CSV next to `protocol.toml` or written out in it as `presses`.

    The CSV has a column `depth_mm` and optionally `tilt_deg`, `dwell_s` and `stroke_id`.
    """

    kind: Literal["list"]
    file: FileName | None = None
    """CSV with a column for each field of a press."""
    dwell_s: DwellS = 0.2
    """Time at full depth of presses that have no `dwell_s` of their own."""
    of: StrokeId | None = None
    """Id of the session whose presses these repeat, under the ids that they had there, to compare mark with mark."""
    presses: Annotated[tuple[PressRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """The presses. Read from `file` where one is named."""

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, values: object, info: ValidationInfo) -> object:
        return _with_rows(values, info, "presses", PressRow)

    @model_validator(mode="after")
    def _named(self) -> Self:
        if self.of is not None and any(row.stroke_id is None for row in self.presses):
            raise ValueError(f"presses: every press that repeats one of {self.of} needs its stroke_id")
        return self

    def round(self, repeat: int) -> list[Planned]:
        """The presses of round `repeat`, counted from 1.

        A press without an id is named after its number in the list, H and alpha, as `003-H15-a5-r01`. A given id gets
        `-r02` and so on from the second round on. `H13-a5-r02` of another session is `H13-a5-r02~1`, then `~2`: an id
        may hold a `~` but not begin with one, so everything before the last `~` is the original's id.
        """
        ending, strokes = f"-r{repeat:02d}", list[Planned]()
        for number, row in enumerate(self.presses, 1):
            name = f"{number:03d}-H{row.depth_mm:g}-a{row.tilt_deg:g}{ending}"
            if row.stroke_id is not None:
                name = row.stroke_id + (ending if repeat > 1 else "")
            again_of = None if self.of is None else row.stroke_id
            if again_of is not None:
                name = f"{again_of}~{repeat}"
            dwell_s = self.dwell_s if row.dwell_s is None else row.dwell_s
            strokes.append(Planned(name, Condition(row.depth_mm, row.tilt_deg), dwell_s=dwell_s, again_of=again_of))
        return strokes


# Figures


class PointRow(Config):
    """One point of a trajectory as a row of a CSV; the fields are in the order of a `TrajectoryPoint`."""

    x_mm: InCellMm
    y_mm: InCellMm
    depth_mm: PathDepthMm = Field(validation_alias=EARLIER_DEPTH)
    tilt_deg: TiltDeg = 0.0
    heading_deg: HeadingDeg = 0.0


class DrawnStroke(Config):
    """One stroke: down at the first point, along the others without a halt, up at the last."""

    file: FileName | None = None
    """CSV with the columns `x_mm`, `y_mm`, `depth_mm` and optionally `tilt_deg` and `heading_deg`."""
    points: Annotated[tuple[TrajectoryPoint, ...], Field(min_length=2, max_length=MAX_STROKE_POINTS)]
    """Points [x_mm, y_mm, depth_mm, tilt_deg, heading_deg]. Read from `file` where one is named."""

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, values: object, info: ValidationInfo) -> object:
        return _with_rows(values, info, "points", PointRow, lambda row: tuple(row.model_dump().values()))

    @model_validator(mode="after")
    def _marks(self) -> Self:
        for number, (a, b) in enumerate(itertools.pairwise(self.points), 2):
            if math.dist(a[:3], b[:3]) < LEAST_APART_MM:
                raise ValueError(f"point {number} is less than {LEAST_APART_MM:g} mm from the previous point")
        if max(point[2] for point in self.points) <= 0.0:
            raise ValueError("no point is below the touch height: nothing would be drawn")
        return self


class Figure(Config):
    """A character or a single drawn line: strokes that share one paper patch."""

    name: Annotated[StrokeId, Field(max_length=60)]
    """The stroke id is this name and the number of the repeat."""
    strokes: Annotated[tuple[DrawnStroke, ...], Field(min_length=1, max_length=100)]
    """The strokes, in the order of writing."""


class WriteConfig(RoundsConfig):
    """Trajectories to draw: x, y, depth, tilt and heading, in the frame of the figure's own paper patch."""

    kind: Literal["write"]
    cell_mm: tuple[CellMm, CellMm]
    """Width and height of the patch for one figure. Its lower left corner is the origin, x along the sheet's x."""
    figures: Annotated[tuple[Figure, ...], Field(min_length=1, max_length=1000)]
    """The figures, in the order of writing."""
    speed_mm_s: Annotated[float, Field(ge=1.0, le=100.0)] = 20.0
    """Speed of the tip along the trajectory."""

    @model_validator(mode="after")
    def _on_the_patch(self) -> Self:
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
            raise ValueError(f"{points} points in all; at most {MAX_POINTS} are allowed")
        return self

    def round(self, repeat: int) -> list[Planned]:
        """Every figure, under the condition of its deepest point."""
        strokes: list[Planned] = []
        for figure in self.figures:
            drawn = Drawn([list(stroke.points) for stroke in figure.strokes], self.speed_mm_s)
            points = itertools.chain.from_iterable(drawn.strokes)
            _, _, depth_mm, tilt_deg, _ = max(points, key=lambda point: point[2])
            strokes.append(Planned(f"{figure.name}-r{repeat:02d}", Condition(depth_mm, tilt_deg), drawn=drawn))
        return strokes
