"""`grid`, `few-strokes`, `list` and `replay`: presses that are known before the first one is made."""

from __future__ import annotations

import random
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, Field, model_validator

from brushloop.calibrate.stats import spread_out
from brushloop.collect.protocols.base import (
    MAX_STROKES,
    DeepMm,
    DwellS,
    FileName,
    ProtocolBase,
    Repeats,
    Seed,
    StrokeId,
    check_axes,
    check_count,
    check_distinct,
    stroke_id_problem,
)
from brushloop.collect.protocols.plan import Planned, numbered, shuffled
from brushloop.collect.protocols.steps import TiltDeg
from brushloop.collect.rig.config_file import Config
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
