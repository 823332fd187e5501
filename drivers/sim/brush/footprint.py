"""From a pressed spine to ink on paper: which hairs come within the ink film, what a flaw changes, what paper absorbs.

Local frame of a cross-section: `across` runs sideways (+y of the paper), `outward` runs away from the paper in the
plane of bending; both are fractions of the free radius, so a bristle is one point of the unit disc. A flaw is added to
the mechanics of a flawless press: forces and the shape of the spine do not change.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.mechanics import Bundle, SpineShape, Vector
from brushloop.drivers.sim.brush.spec import BrushSpec

Image = NDArray[np.float32]

PX_PER_MM = 10.0
"""Scale of the sheet, and of the marks that are laid on it."""
TEXTURE_PX_PER_MM = 10.0
"""Paper texture is drawn at this scale and resized, so that fibres keep their size on any raster."""
DRY_WICK_MM = 0.04
"""Capillary spread of the last ink of a brush."""
HAIR_MM = 0.1
"""Spread of ink around one wet hair."""
FULL_PER_MM2 = 20.0
"""Deposit points per area that fill the ink film."""
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
BLANK_LOAD = 0.02
"""Ink load below which a brush leaves no mark."""


class Flaw(StrEnum):
    """What is wrong with a mark."""

    SPLIT = "split"
    """Two groups of hairs, pushed apart where the tuft is squashed: a gap that opens toward the tip."""
    BENT = "bent"
    """The last third of the bundle has a sideways set: the tip is bowed off the axis."""
    DRY = "dry"
    """Most hairs carry no ink: streaks."""
    FAINT = "faint"
    """Thin ink: the whole outline, but pale."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """One flaw as it happens in one press; m hairs."""

    flaw: Flaw | None
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
        return flow * (self.thirst >= DRY_SHARE * self.severity) if self.flaw is Flaw.DRY else flow

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


FLAWLESS = Trouble(None, 0.0, 1.0, 0.0, np.zeros(0), 0.0)
"""Changes nothing."""


def natural_split(ink_load: float, depth_mm: float, rng: np.random.Generator) -> float:
    """Severity of a split that happens by itself, mostly 0: an emptying brush loses the film that holds it together."""
    chance = SPLIT_CHANCE * max(0.0, 1.0 - ink_load / COHESIVE_LOAD)
    hit, severity = rng.random() < chance, rng.uniform(0.5, 1.0)
    return float(severity) if hit and depth_mm >= SPLIT_DEPTH_MM and ink_load > BLANK_LOAD else 0.0


@dataclass(frozen=True, slots=True)
class Dots:
    """Deposit points on the paper."""

    x_mm: Vector
    y_mm: Vector
    ink: Vector


@dataclass(frozen=True, slots=True)
class Footprint:
    """One press on an unbounded sheet; columns grow with +x (where the ferrule leans), rows with -y."""

    density: Image
    """(h, w) ink per area, 0 = none, 1 = saturated."""
    px_per_mm: float
    origin_px: tuple[float, float]
    """(x, y) of the zero-touch point; pixel (i, j) covers [j, j + 1) x [i, i + 1)."""


def scatter(
    dots: Dots,
    shape_px: tuple[int, int],
    origin: tuple[float, float],
    px_per_mm: float,
    ink_load: float,
    spec: BrushSpec,
) -> Image:
    """Ink offered per area, (h, w): dots spread by the width of a wet hair and its meniscus."""
    h, w = shape_px
    column = np.floor(origin[0] + dots.x_mm * px_per_mm).astype(np.int64).clip(0, w - 1)
    row = np.floor(origin[1] - dots.y_mm * px_per_mm).astype(np.int64).clip(0, h - 1)
    offered = np.bincount(row * w + column, weights=dots.ink, minlength=h * w).reshape(h, w)
    per_mm2 = (offered * px_per_mm**2).astype(np.float32)
    lines = np.asarray(cv2.GaussianBlur(per_mm2, (0, 0), HAIR_MM * px_per_mm), np.float32)
    # hairs on top of each other, as at the tip, hold no more ink between them than the film does
    np.minimum(lines, FULL_PER_MM2, out=lines)
    wick_mm = DRY_WICK_MM + (spec.wick_mm - DRY_WICK_MM) * ink_load
    return np.asarray(cv2.GaussianBlur(lines, (0, 0), wick_mm * px_per_mm), np.float32)


def soak(wet: Image, ink_load: float | Image, px_per_mm: float, rng: np.random.Generator, spec: BrushSpec) -> Image:
    """Ink absorbed, (h, w) in 0 .. 1: fibres decide at the edge and, when the brush is dry, everywhere.

    `ink_load` is one number, or for a drag the load of the brush when it passed each pixel.
    """
    texture = _paper(wet.shape, px_per_mm, rng)
    # a drier brush wets only the peaks of the paper
    need = (spec.need_per_mm2 + 6.0 * (1.0 - ink_load) ** 2) * np.exp((0.2 + 0.9 * (1.0 - ink_load)) * texture)
    cover = wet**3 / (wet**3 + need**3)
    cover = np.asarray(cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 0.05 * px_per_mm), np.float32)
    pooled = 1.0 - np.exp(-wet / 6.0)
    tone = (0.55 + 0.45 * ink_load) * (0.75 + 0.25 * pooled) * (1.0 - 0.03 * texture)
    density = np.clip(cover * tone, 0.0, 1.0)
    density[density < 0.01] = 0.0
    return density.astype(np.float32)


def _paper(shape_px: tuple[int, ...], px_per_mm: float, rng: np.random.Generator) -> Image:
    """Paper texture (h, w) of unit variance: long fibres in three directions over a fine grain."""
    h, w = (int(np.ceil(n * TEXTURE_PX_PER_MM / px_per_mm)) + 1 for n in shape_px)
    field = np.asarray(cv2.GaussianBlur(rng.standard_normal((h, w), np.float32), (0, 0), 1.2), np.float32)
    field /= field.std()
    for angle in (rng.random() + np.arange(3)) * np.pi / 3.0:
        fibres = np.asarray(
            cv2.filter2D(rng.standard_normal((h, w), np.float32), -1, _fibre_kernel(float(angle))), np.float32
        )
        field += fibres / fibres.std()
    field /= field.std()
    sheet = np.empty(shape_px, np.float32)
    cv2.resize(field, (shape_px[1], shape_px[0]), dst=sheet, interpolation=cv2.INTER_LINEAR)
    return sheet


def _fibre_kernel(angle_rad: float) -> Image:
    """An elongated Gaussian, 1.2 mm by 0.12 mm at the texture's scale."""
    y, x = np.mgrid[-12:13, -12:13]
    along = x * np.cos(angle_rad) + y * np.sin(angle_rad)
    aside = y * np.cos(angle_rad) - x * np.sin(angle_rad)
    return np.exp(-0.5 * ((along / 6.0) ** 2 + (aside / 0.6) ** 2)).astype(np.float32)


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


MARGIN_MM = 3.0
"""Blank border around the mark."""
DRY_FILM_MM = 0.12
"""Height over the paper within which a hair gives ink when the brush is all but empty."""
TRAIL_STEPS = 2
"""Load steps between the moments at which the sliding bundle is printed: about 1 mm of descent."""


@dataclass(frozen=True, slots=True)
class Tuft:
    """A wet brush as it meets the paper in one press: its mechanics, its hairs, how they lie, and any flaw."""

    bundle: Bundle
    bristles: Bristles
    trouble: Trouble
    spread: float
    """Factor on the sideways spread."""
    reach_mm: float
    """Extra reach of the tip along the paper."""
    bow_mm: float
    """Sideways offset of the tip when pressed: that of the individual brush, and what this press adds."""
    clump_ink: Vector
    """(CLUMPS,) relative ink per clump."""
    strand_mm: Vector
    """(m,) sideways stray of each hair."""
    place_mm: tuple[float, float]
    """Offset of the whole mark, (x, y)."""

    def touch(self, shape: SpineShape, load: float) -> Dots:
        """Where the bristles of one spine shape come within the ink film of the paper.

        A section that would reach below the paper is cut off flat by it, which lowers its mean half thickness
        from r to r - squash / 2; the half width rises to r (r / (r - squash / 2))^splay_power.
        """
        bundle, bristles, spec = self.bundle, self.bristles, self.bundle.spec
        # after a dip every clump gives ink, below a load of about 0.4 some are dry
        flow = self.trouble.flow(np.clip(1.9 * load - 0.75 * self.clump_ink, 0.0, 1.0)[bristles.clump])
        film_mm = DRY_FILM_MM + (spec.film_mm - DRY_FILM_MM) * load
        link_mm = bundle.link_mm
        node = np.arange(bundle.radius_mm.size, dtype=np.float64)
        near = np.flatnonzero(shape.squash_mm > -film_mm)
        if near.size == 0:
            empty = np.zeros(0)
            return Dots(empty, empty, empty)
        first = max(0.0, float(near[0]) - 1.0)
        at = np.arange(first, node[-1], STATION_MM / link_mm)
        x, z, phi, radius = (np.interp(at, node, v) for v in (shape.x_mm, shape.z_mm, shape.phi_rad, bundle.radius_mm))
        squash = np.interp(at, node, np.maximum(_smooth(shape.squash_mm, spec.splay_reach_mm / link_mm), 0.0))
        flatter = radius / (radius - 0.5 * np.minimum(squash, 0.9 * radius))
        half_width = self.spread * radius * flatter**spec.splay_power

        # (m, stations): rows are bristles
        outward, across = bristles.outward[:, None], bristles.across[:, None]
        dot_z = z + outward * radius * np.sin(phi)
        dot_x = x - outward * radius * np.cos(phi)
        along = (at - first) / max(node[-1] - first, 1.0)
        dot_y = across * half_width + self.bow_mm * along**2 + self.strand_mm[:, None]
        dot_x += bristles.phase_mm[:, None] - self.reach_mm * along
        to_tip = (node[-1] - at) * link_mm
        dot_x, dot_y = self.trouble.displace(dot_x, dot_y, across, to_tip, squash, half_width)
        ends = to_tip >= bristles.short_mm[:, None]
        ink = flow[:, None] * np.clip(1.5 * (1.0 - np.maximum(dot_z, 0.0) / film_mm), 0.0, 1.0) * ends
        inked = ink > 0.0
        aside_x, aside_y = self.place_mm
        return Dots(dot_x[inked] + aside_x, dot_y[inked] + aside_y, ink[inked])


def wet_tuft(bundle: Bundle, bristles: Bristles, trouble: Trouble, rng: np.random.Generator) -> Tuft:
    """Draw what differs between two presses of one condition: how the wet bundle lies, and the ink per clump."""
    spec = bundle.spec
    spread = float(np.exp(spec.spread_wander * rng.standard_normal()))
    reach, bow = rng.normal(0.0, spec.reach_wander_mm), rng.normal(0.0, spec.bow_wander_mm)
    clump_ink, strand = rng.random(CLUMPS), rng.normal(0.0, spec.strand_mm, spec.bristles)
    x, y = rng.normal(0.0, spec.place_wander_mm, 2)
    bow_mm = bristles.bow_mm + float(bow)
    return Tuft(bundle, bristles, trouble, spread, float(reach), bow_mm, clump_ink, strand, (float(x), float(y)))


def print_footprint(
    path: Sequence[SpineShape], tuft: Tuft, ink_load: float, px_per_mm: float, paper_rng: np.random.Generator
) -> Footprint:
    """Print the load path `path` of a tuft as ink on fresh paper."""
    load, spec = tuft.trouble.load(ink_load), tuft.bundle.spec
    # newest first, so that the final shape is always among them
    dots = [tuft.touch(shape, load) for shape in path[::-1][::TRAIL_STEPS]]
    x_mm, y_mm = np.concatenate([d.x_mm for d in dots]), np.concatenate([d.y_mm for d in dots])
    shape_px, origin = frame_around(x_mm, y_mm, px_per_mm, MARGIN_MM)

    # hairs slide over their own wet trail: the sheet keeps the wettest moment, not the sum
    wet = np.zeros(shape_px, np.float32)
    for moment, d in enumerate(dots):
        laid = scatter(d, shape_px, origin, px_per_mm, load, spec)
        np.maximum(wet, laid if moment == 0 else laid * np.float32(spec.trail_share), out=wet)
    density = soak(wet, load, px_per_mm, paper_rng, spec) * np.float32(tuft.trouble.tone)
    return Footprint(density, px_per_mm, origin)


def frame_around(
    x_mm: Vector, y_mm: Vector, px_per_mm: float, margin_mm: float
) -> tuple[tuple[int, int], tuple[float, float]]:
    """(rows, columns) of a raster that holds points and the origin with a margin, and (column, row) of the origin."""
    left, right = x_mm.min(initial=0.0) - margin_mm, x_mm.max(initial=0.0) + margin_mm
    down, up = y_mm.min(initial=0.0) - margin_mm, y_mm.max(initial=0.0) + margin_mm
    shape_px = (int(np.ceil((up - down) * px_per_mm)), int(np.ceil((right - left) * px_per_mm)))
    return shape_px, (float(round(-left * px_per_mm)), float(round(up * px_per_mm)))


def blank_footprint() -> Footprint:
    """An untouched patch of paper around the zero-touch point."""
    half = round(MARGIN_MM * PX_PER_MM)
    return Footprint(np.zeros((2 * half, 2 * half), np.float32), PX_PER_MM, (float(half), float(half)))


def _smooth(values: Vector, sigma: float) -> Vector:
    """Gaussian smoothing along the spine, ends held."""
    reach = int(np.ceil(3.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    held = np.pad(values, reach, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(held, kernel.size) @ (kernel / kernel.sum())
