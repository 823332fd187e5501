"""The hairs of one brush, and how they lie in one press.

A bristle is one point of the unit disc of its cross-section: `across` runs sideways (+y of the paper), `outward` runs
away from the paper in the plane of bending; both are fractions of the free radius.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.sim.brush.spine import Vector

STATION_MM = 0.25
"""Spacing of deposit points along a bristle."""

CLUMPS = 36
"""Wet hairs stick together and run dry together."""


@dataclass(frozen=True, slots=True)
class Bristles:
    """The hairs of one individual brush, m of them."""

    across: Vector
    """(m,) sideways place in the unit disc."""
    outward: Vector
    """(m,) place in the unit disc away from the paper."""
    short_mm: Vector
    """(m,) how far each hair ends before the tip."""
    phase_mm: Vector
    """(m,) where along its length each hair's deposit points start; without it the stations show as ribs."""
    clump: NDArray[np.int64]
    """(m,) which clump of hairs it belongs to, 0 .. CLUMPS - 1."""
    bow_mm: float
    """Sideways offset of the tip when pressed: no bundle is set quite straight."""


@dataclass(frozen=True, slots=True)
class Wander:
    """What differs between two presses of one cell: how the wet bundle lay, and the ink per clump."""

    spread: float
    """Factor on the sideways spread."""
    reach_mm: float
    """Extra reach of the tip along the paper."""
    bow_mm: float
    """Extra sideways offset of the tip."""
    clump_ink: Vector
    """(CLUMPS,) relative ink per clump."""
    strand_mm: Vector
    """(m,) sideways stray of each hair."""


def grow_bristles(count: int, rng: np.random.Generator) -> Bristles:
    """Draw `count` bristles evenly over the unit disc, clumped by nearest of `CLUMPS` random centres."""
    # sunflower spiral with jitter: even cover without a visible lattice
    k = np.arange(count) + 0.5
    ring = np.sqrt(k / count)
    turn = k * np.pi * (3.0 - np.sqrt(5.0)) + rng.normal(0.0, 0.15, count)
    across, outward = ring * np.cos(turn), ring * np.sin(turn)
    centre_ring, centre_turn = np.sqrt(rng.random(CLUMPS)), rng.random(CLUMPS) * 2.0 * np.pi
    far = np.hypot(
        across[:, None] - centre_ring * np.cos(centre_turn),
        outward[:, None] - centre_ring * np.sin(centre_turn),
    )
    short = np.abs(rng.normal(0.0, 4.0, count)) * np.sqrt(ring)
    phase = STATION_MM * (rng.random(count) - 0.5)
    return Bristles(across, outward, short, phase, far.argmin(axis=1), float(rng.normal(0.0, 0.25)))


def draw_wander(count: int, rng: np.random.Generator) -> Wander:
    """Draw the natural variation of one press: 1.5 % of width, and 0.1 to 0.2 mm in where the tip lies."""
    spread = float(np.exp(0.015 * rng.standard_normal()))
    reach, bow = rng.normal(0.0, 0.15), rng.normal(0.0, 0.12)
    return Wander(spread, float(reach), float(bow), rng.random(CLUMPS), rng.normal(0.0, 0.06, count))


def clump_flow(clump_ink: Vector, ink_load: float) -> Vector:
    """Ink flow (CLUMPS,) in 0 .. 1: all clumps run when dipped, below a load of about 0.4 some are dry."""
    return np.clip(1.9 * ink_load - 0.75 * clump_ink, 0.0, 1.0)
