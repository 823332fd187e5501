"""From a pressed spine to ink on paper: which hairs come within the ink film, and where they lie.

Local frame of a cross-section: `across` runs sideways (+y of the paper), `outward` runs away from the paper in the
plane of bending; both are fractions of the free radius, so a bristle is one point of the unit disc.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.flaws import Trouble
from brushloop.drivers.sim.brush.mechanics import Bundle, SpineShape, Vector
from brushloop.drivers.sim.brush.paper import Dots, Footprint, scatter, soak
from brushloop.drivers.sim.brush.spec import BrushSpec

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
    """(m,) distance from each hair's end to the tip."""
    phase_mm: Vector
    """(m,) where along its length each hair's deposit points start; without this the stations would show as ribs."""
    clump: NDArray[np.int64]
    """(m,) which clump of hairs it belongs to, 0 .. CLUMPS - 1."""
    bow_mm: float
    """Sideways offset of the tip when pressed: no bundle is set quite straight."""


@dataclass(frozen=True, slots=True)
class Wander:
    """What differs between two presses of one cell: how the wet bundle lies, and the ink per clump."""

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
    place_mm: tuple[float, float]
    """Offset of the whole mark, (x, y)."""


def grow_bristles(spec: BrushSpec, rng: np.random.Generator) -> Bristles:
    """Draw the bristles evenly over the unit disc, clumped by nearest of `CLUMPS` random centres."""
    # sunflower spiral with jitter: even cover without a visible lattice
    count = spec.bristles
    k = np.arange(count) + 0.5
    ring = np.sqrt(k / count)
    turn = k * np.pi * (3.0 - np.sqrt(5.0)) + rng.normal(0.0, 0.15, count)
    across, outward = ring * np.cos(turn), ring * np.sin(turn)
    centre_ring, centre_turn = np.sqrt(rng.random(CLUMPS)), rng.random(CLUMPS) * 2.0 * np.pi
    far = np.hypot(
        across[:, None] - centre_ring * np.cos(centre_turn),
        outward[:, None] - centre_ring * np.sin(centre_turn),
    )
    short = np.abs(rng.normal(0.0, spec.uneven_mm, count)) * np.sqrt(ring)
    phase = STATION_MM * (rng.random(count) - 0.5)
    return Bristles(across, outward, short, phase, far.argmin(axis=1), float(rng.normal(0.0, spec.bow_mm)))


def draw_wander(spec: BrushSpec, rng: np.random.Generator) -> Wander:
    """Draw the natural variation of one press."""
    spread = float(np.exp(spec.spread_wander * rng.standard_normal()))
    reach, bow = rng.normal(0.0, spec.reach_wander_mm), rng.normal(0.0, spec.bow_wander_mm)
    clump_ink, strand = rng.random(CLUMPS), rng.normal(0.0, spec.strand_mm, spec.bristles)
    x, y = rng.normal(0.0, spec.place_wander_mm, 2)
    return Wander(spread, float(reach), float(bow), clump_ink, strand, (float(x), float(y)))


def clump_flow(clump_ink: Vector, ink_load: float) -> Vector:
    """Ink flow (CLUMPS,) in 0 .. 1: after a dip every clump gives ink, below a load of about 0.4 some are dry."""
    return np.clip(1.9 * ink_load - 0.75 * clump_ink, 0.0, 1.0)


MARGIN_MM = 3.0
"""Blank border around the mark."""

DRY_FILM_MM = 0.12
"""Height over the paper within which a hair gives ink when the brush is all but empty."""

TRAIL_STEPS = 2
"""Load steps between the moments at which the sliding bundle is printed: about 1 mm of descent."""


@dataclass(frozen=True, slots=True)
class Tuft:
    """A wet brush as it meets the paper: its mechanics, its hairs, how they lie in this press, and any flaw."""

    spec: BrushSpec
    bundle: Bundle
    bristles: Bristles
    wander: Wander
    trouble: Trouble | None = None

    def load(self, ink_load: float) -> float:
        """The load that the hairs carry to the paper."""
        return ink_load if self.trouble is None else self.trouble.load(ink_load)

    def touch(self, shape: SpineShape, load: float) -> Dots:
        """Where the bristles of one spine shape come within the ink film of the paper.

        A section that would reach below the paper is cut off flat by it, which lowers its mean half thickness
        from r to r - squash / 2; the half width rises to r (r / (r - squash / 2))^splay_power.
        """
        bundle, bristles, wander = self.bundle, self.bristles, self.wander
        flow = clump_flow(wander.clump_ink, load)[bristles.clump]
        if self.trouble is not None:
            flow = self.trouble.flow(flow)
        film_mm = DRY_FILM_MM + (self.spec.film_mm - DRY_FILM_MM) * load
        link_mm = bundle.link_mm
        node = np.arange(bundle.radius_mm.size, dtype=np.float64)
        near = np.flatnonzero(shape.squash_mm > -film_mm)
        if near.size == 0:
            empty = np.zeros(0)
            return Dots(empty, empty, empty)
        first = max(0.0, float(near[0]) - 1.0)
        at = np.arange(first, node[-1], STATION_MM / link_mm)
        x, z, phi, radius = (np.interp(at, node, v) for v in (shape.x_mm, shape.z_mm, shape.phi_rad, bundle.radius_mm))
        squash = np.interp(at, node, np.maximum(_smooth(shape.squash_mm, self.spec.splay_reach_mm / link_mm), 0.0))
        flatter = radius / (radius - 0.5 * np.minimum(squash, 0.9 * radius))
        half_width = wander.spread * radius * flatter**self.spec.splay_power

        # (m, stations): rows are bristles
        outward, across = bristles.outward[:, None], bristles.across[:, None]
        dot_z = z + outward * radius * np.sin(phi)
        dot_x = x - outward * radius * np.cos(phi)
        along = (at - first) / max(node[-1] - first, 1.0)
        bow = (bristles.bow_mm + wander.bow_mm) * along**2
        dot_y = across * half_width + bow + wander.strand_mm[:, None]
        dot_x += bristles.phase_mm[:, None] - wander.reach_mm * along
        if self.trouble is not None:
            dot_x, dot_y = self.trouble.displace(dot_x, dot_y, across, (node[-1] - at) * link_mm, squash, half_width)
        ends = (node[-1] - at) * link_mm >= bristles.short_mm[:, None]
        ink = flow[:, None] * np.clip(1.5 * (1.0 - np.maximum(dot_z, 0.0) / film_mm), 0.0, 1.0) * ends
        inked = ink > 0.0
        aside_x, aside_y = wander.place_mm
        return Dots(dot_x[inked] + aside_x, dot_y[inked] + aside_y, ink[inked])


def print_footprint(
    path: Sequence[SpineShape], tuft: Tuft, ink_load: float, px_per_mm: float, paper_rng: np.random.Generator
) -> Footprint:
    """Print the load path `path` of a tuft as ink on fresh paper."""
    load = tuft.load(ink_load)
    # newest first, so that the final shape is always among them
    dots = [tuft.touch(shape, load) for shape in path[::-1][::TRAIL_STEPS]]
    shape_px, origin = frame_around(dots, px_per_mm, MARGIN_MM)

    # hairs slide over their own wet trail: the sheet keeps the wettest moment, not the sum
    wet = np.zeros(shape_px, np.float32)
    for moment, d in enumerate(dots):
        laid = scatter(d, shape_px, origin, px_per_mm, load, tuft.spec)
        np.maximum(wet, laid if moment == 0 else laid * np.float32(tuft.spec.trail_share), out=wet)
    density = soak(wet, load, px_per_mm, paper_rng, tuft.spec)
    if tuft.trouble is not None:
        density = density * np.float32(tuft.trouble.tone)
    return Footprint(density, px_per_mm, origin)


def frame_around(
    dots: Sequence[Dots], px_per_mm: float, margin_mm: float
) -> tuple[tuple[int, int], tuple[float, float]]:
    """(rows, columns) of a raster that holds the dots and the origin with a margin, and (column, row) of the origin."""
    x = np.concatenate([d.x_mm for d in dots])
    y = np.concatenate([d.y_mm for d in dots])
    left, right = min(0.0, x.min(initial=0.0)) - margin_mm, max(0.0, x.max(initial=0.0)) + margin_mm
    down, up = min(0.0, y.min(initial=0.0)) - margin_mm, max(0.0, y.max(initial=0.0)) + margin_mm
    shape_px = (int(np.ceil((up - down) * px_per_mm)), int(np.ceil((right - left) * px_per_mm)))
    return shape_px, (float(round(-left * px_per_mm)), float(round(up * px_per_mm)))


def blank_footprint(px_per_mm: float) -> Footprint:
    """An untouched patch of paper around the zero-touch point."""
    half = int(np.ceil(MARGIN_MM * px_per_mm))
    return Footprint(np.zeros((2 * half, 2 * half), np.float32), px_per_mm, (float(half), float(half)))


def _smooth(values: Vector, sigma: float) -> Vector:
    """Gaussian smoothing along the spine, ends held."""
    reach = int(np.ceil(3.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    held = np.pad(values, reach, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(held, kernel.size) @ (kernel / kernel.sum())
