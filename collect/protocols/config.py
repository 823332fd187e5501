"""`protocol.toml`: a frozen union by `kind`. Rows of side files become part of it, so that its dump is all there is."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from collect.protocols.rows import DeepMm, DrawnStroke, DwellS, PressRow, ReplayRow, TiltDeg, stroke_id_problem
from collect.rig.config_file import Config, Finite

MAX_STROKES = 10_000
"""Of one protocol, repeats included: a month of pressing."""
MAX_POINTS = 10_000
"""Of all trajectories of one protocol together."""

Repeats = Annotated[int, Field(ge=1, le=1000)]
Seed = Annotated[int, Field(ge=0)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]
CellMm = Annotated[float, Field(ge=10.0, le=500.0)]


class ProtocolBase(Config):
    """What every protocol may say."""

    board_every: Annotated[int, Field(ge=1, le=MAX_STROKES)] | None = None
    """Look at the board again after so many strokes, to see whether camera or sheet moved; left out, only at the
    start."""
    wait_after_dip_s: Annotated[float, Field(ge=0.0, le=600.0)] | None = Field(
        default=None, exclude_if=lambda wait_s: wait_s is None
    )
    """Wait over the cell until so much time has passed since the brush left the ink; left out, it presses at once, and
    a protocol reads as it did before there were waits."""


class GridConfig(ProtocolBase):
    """The paper's grid: every depth at every tilt, `repeats` times, in an order shuffled by `seed`.

    Where the layout of the sheet is known, the order also spreads each (H, alpha) over the sheet (`protocols.balance`).
    """

    kind: Literal["grid"]
    heights_mm: Annotated[list[DeepMm], Field(min_length=1, max_length=100)]
    """Depths H below the touch height."""
    tilts_deg: Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
    """Tilts alpha from the paper's normal."""
    repeats: Repeats = 10
    """Rounds: each holds every (H, alpha) once."""
    seed: Seed = 1
    """Of the order."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _distinct(self) -> GridConfig:
        for name in ("heights_mm", "tilts_deg"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name} has the same value twice: {values}")
        _bounded(len(self.heights_mm) * len(self.tilts_deg) * self.repeats)
        return self


class AdaptiveConfig(ProtocolBase):
    """Presses chosen one by one, each where it tells most about the brush; stops where little is left to be won."""

    kind: Literal["adaptive"]
    heights_mm: Annotated[list[DeepMm], Field(min_length=1, max_length=100)]
    """Depths H below the touch height."""
    tilts_deg: Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
    """Tilts alpha from the paper's normal."""
    repeats: Repeats = 10
    """Of the shuffled grid that it stands in for: what it saved is told against that grid's number of presses."""
    most_presses: Annotated[int, Field(ge=1, le=MAX_STROKES)] | None = None
    """Stop after so many at the latest; left out, as many as the grid has. No fewer than the cells: limits, ink and
    sheets are planned for the worst case, and every cell may be chosen."""
    least_presses: Annotated[int, Field(ge=3, le=1000)] = 5
    """Do not stop before."""
    enough_points: Annotated[float, Field(gt=0.0, le=50.0)] = 1.0
    """Stop when fewer points of CSIM (percent), in the mean over all cells, are expected to be won by pressing on."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _whole(self) -> AdaptiveConfig:
        for name in ("heights_mm", "tilts_deg"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name} has the same value twice: {values}")
        _bounded(self.whole_grid)
        cells = len(self.heights_mm) * len(self.tilts_deg)
        if self.most < cells:
            raise ValueError(f"most_presses = {self.most}: at least the {cells} cells of the grid")
        if self.least_presses > self.most:
            raise ValueError(f"least_presses = {self.least_presses}: at most most_presses = {self.most}")
        return self

    @property
    def whole_grid(self) -> int:
        """Presses of the grid that it stands in for."""
        return len(self.heights_mm) * len(self.tilts_deg) * self.repeats

    @property
    def most(self) -> int:
        """Presses in the worst case."""
        return self.whole_grid if self.most_presses is None else self.most_presses


class ListConfig(ProtocolBase):
    """Presses one by one, from a CSV next to `protocol.toml` or written out in it."""

    kind: Literal["list"]
    file: FileName | None = None
    """CSV with a column `height_mm` and, as one likes, `tilt_deg`, `dwell_s` and `stroke_id`."""
    presses: Annotated[tuple[PressRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """What is pressed. Read from `file` where one is named."""
    repeats: Repeats = 1
    """Rounds: each holds every press once."""
    seed: Seed | None = None
    """Shuffles each round; left out, the order is that of the list."""
    dwell_s: DwellS = 0.2
    """Time at full depth, where a press names none."""

    @model_validator(mode="after")
    def _named_apart(self) -> ListConfig:
        _bounded(len(self.presses) * self.repeats)
        _distinct_ids("presses", [name for repeat in range(1, self.repeats + 1) for name in self.names(repeat)])
        return self

    def names(self, repeat: int) -> list[str]:
        """Stroke ids of one round, from 1.

        A press without an id is called by its number in the list, H and alpha, as `003-H15-a5-r01`. Where one was given
        and there are several rounds, `-r02` and so on is added from the second round on.
        """
        ending = f"-r{repeat:02d}"
        return [
            row.stroke_id + (ending if repeat > 1 else "")
            if row.stroke_id is not None
            else f"{number:03d}-H{row.height_mm:g}-a{row.tilt_deg:g}{ending}"
            for number, row in enumerate(self.presses, 1)
        ]


class ReplayConfig(ProtocolBase):
    """Press again what an inversion recovered from the images of an earlier session, to compare mark with mark."""

    kind: Literal["replay"]
    of: Annotated[str, Field(min_length=1, max_length=100)]
    """Id of the session whose strokes they were."""
    file: FileName | None = None
    """CSV with the columns `stroke_id`, `height_mm` and `tilt_deg`; any other column is ignored and named in
    `ignored_columns`."""
    presses: Annotated[tuple[ReplayRow, ...], Field(min_length=1, max_length=MAX_STROKES)]
    """What is pressed again, by the id that the stroke had. Read from `file` where one is named."""
    ignored_columns: tuple[str, ...] = ()
    """Columns of `file` that nothing was done with."""
    repeats: Repeats = 1
    """How often each is pressed again; each round holds every stroke once."""
    seed: Seed | None = None
    """Shuffles each round; left out, the order is that of the list."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _named_apart(self) -> ReplayConfig:
        if problem := stroke_id_problem(self.of):
            raise ValueError(f"of = {self.of!r}: {problem}")
        _distinct_ids("presses", [row.stroke_id for row in self.presses])
        _bounded(len(self.presses) * self.repeats)
        return self


class Figure(Config):
    """A character or a single drawn line: strokes that share one paper cell."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    """Its stroke id is this and the number of the repeat."""
    strokes: Annotated[tuple[DrawnStroke, ...], Field(min_length=1, max_length=100)]
    """In the order of writing."""


class WriteConfig(ProtocolBase):
    """Draw trajectories: x, y, depth, tilt and heading, in the frame of the figure's own paper cell."""

    kind: Literal["write"]
    cell_mm: tuple[CellMm, CellMm]
    """Width and height of the patch for one figure. Its lower left corner is the origin, x along the sheet's x."""
    figures: Annotated[tuple[Figure, ...], Field(min_length=1, max_length=1000)]
    """What is written."""
    repeats: Repeats = 1
    """Rounds: each holds every figure once."""
    seed: Seed | None = None
    """Shuffles each round; left out, the order is that of the list."""
    speed_mm_s: Annotated[float, Field(ge=1.0, le=100.0)] = 20.0
    """Of the tip along the trajectory."""
    blend_mm: Annotated[float, Field(ge=1.0, le=20.0)] = 1.0
    """How near to a point the tip may leave it for the next, so that the arm does not halt there. ARCS takes no less
    than 1 mm."""
    dip_every_strokes: Annotated[int, Field(ge=0, le=100)] = 1
    """Dip again within a figure after so many strokes; 0 writes it with one dip."""

    @model_validator(mode="after")
    def _on_the_cell(self) -> WriteConfig:
        names = [figure.name for figure in self.figures]
        for name in names:
            if problem := stroke_id_problem(name):
                raise ValueError(f"figure {name!r}: {problem}")
        _distinct_ids("figures", names)
        _bounded(len(self.figures) * self.repeats)
        points = 0
        for figure in self.figures:
            for number, stroke in enumerate(figure.strokes, 1):
                points += len(stroke.points)
                for x_mm, y_mm, *_ in stroke.points:
                    if not (0.0 <= x_mm <= self.cell_mm[0] and 0.0 <= y_mm <= self.cell_mm[1]):
                        raise ValueError(
                            f"figure {figure.name}, stroke {number}: the point [{x_mm:g}, {y_mm:g}] lies outside its "
                            f"cell of {self.cell_mm[0]:g} x {self.cell_mm[1]:g} mm"
                        )
        if points > MAX_POINTS:
            raise ValueError(f"{points} points in all, at most {MAX_POINTS}")
        return self


class CalibrationConfig(ProtocolBase):
    """Touches and views of the board, nothing else: no ink, no mark."""

    kind: Literal["calibration"]
    touches_mm: Annotated[tuple[tuple[Finite, Finite], ...], Field(max_length=200)] = ()
    """Points of the sheet to touch, x and y in the paper frame. Three that are no line give the sheet's lean."""
    rounds: Annotated[int, Field(ge=1, le=100)] = 1
    """How often all of them are touched: the spread of a point over the rounds tells how well a touch repeats."""
    board_views: Annotated[int, Field(ge=1, le=1000)] = 1
    """How often the board is looked at in each round."""

    @model_validator(mode="after")
    def _apart(self) -> CalibrationConfig:
        if self.board_every is not None:
            raise ValueError("board_every counts strokes, and this protocol has none: use board_views")
        if self.wait_after_dip_s is not None:
            raise ValueError("wait_after_dip_s: this protocol has no dips")
        if len(set(self.touches_mm)) != len(self.touches_mm):
            raise ValueError("touches_mm has the same point twice: use rounds")
        _bounded((len(self.touches_mm) + self.board_views) * self.rounds)
        return self


ProtocolConfig = GridConfig | AdaptiveConfig | ListConfig | ReplayConfig | WriteConfig | CalibrationConfig
TaggedProtocol = Annotated[ProtocolConfig, Field(discriminator="kind")]


def _bounded(strokes: int) -> None:
    if strokes > MAX_STROKES:
        raise ValueError(f"{strokes} strokes with repeats, at most {MAX_STROKES}")


def _distinct_ids(field: str, ids: list[str]) -> None:
    seen: set[str] = set()
    for ident in ids:
        if ident in seen:
            raise ValueError(f"{field}: {ident!r} is there twice")
        seen.add(ident)
