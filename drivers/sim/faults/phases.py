"""The phase of the arm, from the true place and motion of its tip, not from what a client asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.config import Table
from brushloop.drivers.sim.world import World

ON_PAPER_MM = 0.1
"""A tip that ends or rests no farther above than this counts as on the paper, which is taught with an error."""
ALL_BUT_THERE_MM = 0.1
"""Remaining descent that counts as pressed: a dwell is the very slow end of a descent."""
LIFT_MM = 10.0
"""Distance from the paper within which rising counts as lifting."""
HOME_MM = 1.0


class Phase(StrEnum):
    """What the arm is doing: the first of these that applies."""

    DIPPING = "dipping"
    """Over the well, and below its rim or on the way there."""
    PRESSED = "pressed"
    """On or below the paper plane, over the sheet: at rest, or in the last tenth of a millimetre of the way down."""
    DESCENDING = "descending"
    """Over the sheet, on a line down that ends on or below the paper plane."""
    LIFTING = "lifting"
    """Over the sheet, rising from the paper or from just above it."""
    TRAVELLING = "travelling"
    """Any other motion."""
    PARKED = "parked"
    """At rest where the tip was when the rig started, which is where its `rig.toml` parks it."""
    RESTING = "resting"
    """At rest anywhere else."""


@dataclass(frozen=True, slots=True)
class Spot:
    """A place of the tip: x and y in the paper frame, and its distance from the paper along the paper's normal."""

    x_mm: float
    y_mm: float
    above_mm: float

    def distance_mm(self, other: Spot) -> float:
        """Straight-line distance."""
        return math.dist((self.x_mm, self.y_mm, self.above_mm), (other.x_mm, other.y_mm, other.above_mm))


def phase_of(table: Table, home: Spot, here: Spot, to: Spot | None) -> Phase:
    """The phase of a tip at `here`, on its way to `to`, which is None at rest."""
    above_mm = [spot.above_mm for spot in (here, to) if spot is not None]
    if _over_well(table, here) and min(above_mm) < table.well_depth_mm:
        return Phase.DIPPING
    over_sheet = _over_sheet(table, here)
    if to is None:
        if over_sheet and here.above_mm <= ON_PAPER_MM:
            return Phase.PRESSED
        return Phase.PARKED if here.distance_mm(home) <= HOME_MM else Phase.RESTING
    if over_sheet and here.above_mm < 0.0 and 0.0 <= here.above_mm - to.above_mm <= ALL_BUT_THERE_MM:
        return Phase.PRESSED
    if over_sheet and to.above_mm < here.above_mm and to.above_mm <= ON_PAPER_MM:
        return Phase.DESCENDING
    if over_sheet and to.above_mm > here.above_mm and here.above_mm <= LIFT_MM:
        return Phase.LIFTING
    return Phase.TRAVELLING


def _over_well(table: Table, spot: Spot) -> bool:
    return math.dist((spot.x_mm, spot.y_mm), table.well_mm) <= table.well_radius_mm


def _over_sheet(table: Table, spot: Spot) -> bool:
    return 0.0 <= spot.x_mm <= table.sheet_mm[0] and 0.0 <= spot.y_mm <= table.sheet_mm[1]


class Truth:
    """The facts about one world that faults may wait for. Use it in the thread that owns the world."""

    def __init__(self, world: World) -> None:
        self._world = world

    def now_s(self) -> float:
        """Simulated seconds since the rig started."""
        return self._world.clock.now_s()

    @property
    def presses(self) -> int:
        """Marks on the paper so far: the index of the press to come."""
        return len(self._world.presses)

    def target(self) -> Pose | None:
        """End of the piece of the path that is being travelled; None at rest."""
        queue = self._world.motion
        queue.advance(self.now_s())
        line = queue.running
        return None if line is None else line.pose(line.end_s)

    def phase(self) -> Phase:
        """The phase of the arm now."""
        config, to = self._world.config, self.target()
        return phase_of(
            config.table,
            self._spot(*config.home_mm),
            self._spot(*self._world.tool().position_mm),
            None if to is None else self._spot(*to.position_mm),
        )

    def _spot(self, x_mm: float, y_mm: float, z_mm: float) -> Spot:
        x_mm, y_mm = self._world.to_paper(x_mm, y_mm)
        return Spot(x_mm, y_mm, self._world.config.table.above_mm(x_mm, y_mm, z_mm))
