"""Flaws of a press, and how each changes the place and the ink of the hairs.

A flaw is added to the mechanics of a flawless press: forces and the shape of the spine do not change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from brushloop.drivers.sim.brush.mechanics import Vector

CLEFT_RAD = math.radians(13.0)
"""Angle at which each half of a fully split tuft leaves the axis."""

BEND_RAD = math.radians(55.0)
"""How far a fully bent tip has turned sideways at its end."""

BENT_SHARE = 1.0 / 3.0
"""Share of the bundle, from the tip, that a bend runs over."""

DRY_SHARE = 0.9
"""Share of the hairs without an ink film when a brush is fully dry."""

SPENT = 0.7
"""Share of the ink that the other hairs of a fully dry brush lack."""

PALE = 0.75
"""Share of the tone that is missing in fully faint ink."""

COHESIVE_LOAD = 0.7
"""Ink load above which the film between the hairs always holds the tip together."""

SPLIT_CHANCE = 0.6
"""Chance that an empty brush splits in a press."""

SPLIT_DEPTH_MM = 3.0
"""Shallower presses do not push the hairs apart."""

FAINT_LOAD, DRY_LOAD, BLANK_LOAD = 0.5, 0.3, 0.02
"""Ink loads below which a flawless brush leaves a faint, a dry, a blank mark."""


class Flaw(StrEnum):
    """What is wrong with a mark."""

    SPLIT = "split"
    """Two groups of hairs, pushed apart where the tuft is squashed: a gap that opens toward the tip."""
    BENT = "bent"
    """The last third of the bundle has a sideways set: the tip is bowed off the axis."""
    DRY = "dry"
    """Most hairs carry no ink: streaks."""
    BLANK = "blank"
    """No ink at all; severity makes no difference."""
    FAINT = "faint"
    """Thin ink: the whole outline, but pale."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """One flaw as it happens in one press; m hairs."""

    flaw: Flaw
    severity: float
    """From 0, none, to 1, the worst."""
    side: float
    """+1 or -1: where a bent tip goes."""
    cleft: float
    """Sideways place in the unit disc at which a split tuft parts."""
    thirst: Vector
    """(m,) order in which the hairs run dry, 0 .. 1."""
    length_mm: float
    """Free length of the bundle."""

    @property
    def tone(self) -> float:
        """Factor on the ink per area."""
        return 1.0 - PALE * self.severity if self.flaw is Flaw.FAINT else 1.0

    def load(self, ink_load: float) -> float:
        """The ink load that still reaches the paper."""
        return ink_load * (1.0 - SPENT * self.severity) if self.flaw is Flaw.DRY else ink_load

    def flow(self, flow: Vector) -> Vector:
        """Ink flow (m,) per hair, given that of a flawless press."""
        if self.flaw is Flaw.BLANK:
            return np.zeros_like(flow)
        if self.flaw is Flaw.DRY:
            return flow * (self.thirst >= DRY_SHARE * self.severity)
        return flow

    def displace(
        self, x_mm: Vector, y_mm: Vector, across: Vector, to_tip_mm: Vector, squash_mm: Vector, half_width_mm: Vector
    ) -> tuple[Vector, Vector]:
        """Deposit points (m, stations) after the flaw; `to_tip_mm`, squash and half width are (stations,)."""
        if self.flaw is Flaw.SPLIT:
            return x_mm, y_mm + self._parted(across, to_tip_mm, squash_mm, half_width_mm)
        if self.flaw is Flaw.BENT:
            return self._bowed(x_mm, y_mm, to_tip_mm)
        return x_mm, y_mm

    def _parted(self, across: Vector, to_tip_mm: Vector, squash_mm: Vector, half_width_mm: Vector) -> Vector:
        # the tuft parts where it is squashed most, and each half then runs straight on
        beyond = np.maximum(0.0, to_tip_mm[int(squash_mm.argmax())] - to_tip_mm)
        group = np.where(across >= self.cleft, 1.0, -1.0)
        middle = 0.5 * (self.cleft + group)
        # a half of the tuft is a tuft of its own: wet hairs gather round its own axis
        gathered = 0.45 * self.severity * np.clip(beyond / 6.0, 0.0, 1.0) * (middle - across) * half_width_mm
        return group * math.tan(CLEFT_RAD) * self.severity * beyond + gathered

    def _bowed(self, x_mm: Vector, y_mm: Vector, to_tip_mm: Vector) -> tuple[Vector, Vector]:
        reach_mm = BENT_SHARE * self.length_mm
        gone = np.clip(1.0 - to_tip_mm / reach_mm, 0.0, 1.0)
        # the bend shows as far as the tip lies down: a tip that just touches is not displaced
        lying = min(1.0, float(to_tip_mm[0]) / (0.5 * self.length_mm))
        full = max(BEND_RAD * self.severity * lying, 1e-9)
        turn = full * gone
        aside = reach_mm * (1.0 - np.cos(turn)) / full
        lost = reach_mm * (gone - np.sin(turn) / full)
        return x_mm + lost + self.side * y_mm * np.sin(turn), y_mm * np.cos(turn) + self.side * aside


def draw_trouble(flaw: Flaw, severity: float, hairs: int, length_mm: float, rng: np.random.Generator) -> Trouble:
    """Draw the details of one flaw at random: which side, where it parts, which hairs are dry."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    cleft = rng.uniform(-0.25, 0.25)
    thirst = rng.random(hairs).argsort().argsort() / hairs
    return Trouble(flaw, severity, side, cleft, thirst, length_mm)


def natural_split(ink_load: float, depth_mm: float, rng: np.random.Generator) -> float:
    """Severity of a split that happens by itself, mostly 0: an emptying brush loses the film that holds it together."""
    chance = SPLIT_CHANCE * max(0.0, 1.0 - ink_load / COHESIVE_LOAD)
    hit, severity = rng.random() < chance, rng.uniform(0.5, 1.0)
    return float(severity) if hit and depth_mm >= SPLIT_DEPTH_MM and ink_load > BLANK_LOAD else 0.0


def flaw_of_load(ink_load: float) -> Flaw | None:
    """The flaw that lack of ink alone causes in a mark; None if there is enough ink."""
    if ink_load <= BLANK_LOAD:
        return Flaw.BLANK
    if ink_load <= DRY_LOAD:
        return Flaw.DRY
    return Flaw.FAINT if ink_load <= FAINT_LOAD else None
