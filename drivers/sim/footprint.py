"""From a pressed spine to ink on paper: bristles, capillary spread, paper fibres and tone.

Local frame of a cross-section: `across` runs sideways (+y of the paper), `outward` runs away from the paper
in the plane of bending; both are fractions of the free radius, so a bristle is one point of the unit disc.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.spine import Bundle, SpineShape, Vector

Image = NDArray[np.float32]

MARGIN_MM = 3.0
"""Blank border around the mark."""

STATION_MM = 0.25
"""Spacing of deposit points along a bristle."""

TRAIL_STEPS = 2
"""Load steps between the moments at which the sliding bundle is printed: about 1 mm of descent."""

TEXTURE_PX_PER_MM = 10.0
"""Paper texture is drawn at this scale and resized, so that fibres keep their size on any raster."""

HAIR_MM = 0.1
"""Spread of ink around one wet hair."""

FULL_PER_MM2 = 20.0
"""Deposit points per area that fill the ink film."""

SPREAD_POWER = 1.7
"""Half width of a flattened section as a power of its mean flattening: 1 would keep its area, more lets
the hairs part."""

CLUMPS = 36
"""Wet hairs stick together and run dry together."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """One press on an unbounded sheet; columns grow with +x (where the ferrule leans), rows with -y."""

    density: Image
    """(h, w) ink per area, 0 = none, 1 = saturated."""
    px_per_mm: float
    origin_px: tuple[float, float]
    """(x, y) of the zero-touch point; pixel (i, j) covers [j, j + 1) x [i, i + 1)."""
    contact_force_n: float


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


@dataclass(frozen=True, slots=True)
class _Dots:
    """Deposit points on the paper."""

    x_mm: Vector
    y_mm: Vector
    ink: Vector


def print_footprint(
    path: Sequence[SpineShape],
    bundle: Bundle,
    bristles: Bristles,
    wander: Wander,
    ink_load: float,
    px_per_mm: float,
    paper_rng: np.random.Generator,
) -> Footprint:
    """Print the load path `path` of `bundle` as ink on fresh paper."""
    flow = _clump_flow(wander.clump_ink, ink_load)[bristles.clump]
    film_mm = 0.12 + 0.38 * ink_load
    # newest first, so that the final shape is always among them
    printed = path[::-1][::TRAIL_STEPS]
    dots = [_touch(shape, bundle, bristles, wander, flow, film_mm) for shape in printed]
    force = float(path[-1].normal_n.sum())
    x = np.concatenate([d.x_mm for d in dots])
    y = np.concatenate([d.y_mm for d in dots])
    left, right = min(0.0, x.min(initial=0.0)) - MARGIN_MM, max(0.0, x.max(initial=0.0)) + MARGIN_MM
    down, up = min(0.0, y.min(initial=0.0)) - MARGIN_MM, max(0.0, y.max(initial=0.0)) + MARGIN_MM
    shape_px = (int(np.ceil((up - down) * px_per_mm)), int(np.ceil((right - left) * px_per_mm)))
    origin = (float(round(-left * px_per_mm)), float(round(up * px_per_mm)))

    # hairs slide over their own wet trail: the sheet keeps the wettest moment, not the sum
    wet = np.zeros(shape_px, np.float32)
    for d in dots:
        np.maximum(wet, _scatter(d, shape_px, origin, px_per_mm, ink_load), out=wet)
    density = _soak(wet, ink_load, px_per_mm, paper_rng)
    return Footprint(density, px_per_mm, origin, force)


def blank_footprint(px_per_mm: float) -> Footprint:
    """An untouched patch of paper around the zero-touch point."""
    half = int(np.ceil(MARGIN_MM * px_per_mm))
    return Footprint(np.zeros((2 * half, 2 * half), np.float32), px_per_mm, (float(half), float(half)), 0.0)


def _clump_flow(clump_ink: Vector, ink_load: float) -> Vector:
    """Ink flow (CLUMPS,) in 0 .. 1: all clumps run when dipped, below a load of about 0.4 some are dry."""
    return np.clip(1.9 * ink_load - 0.75 * clump_ink, 0.0, 1.0)


def _touch(
    shape: SpineShape,
    bundle: Bundle,
    bristles: Bristles,
    wander: Wander,
    flow: Vector,
    film_mm: float,
) -> _Dots:
    """Where the bristles of one spine shape come within the ink film of the paper.

    A section that would reach below the paper is cut off flat by it, which lowers its mean half thickness
    from r to r - squash / 2; the half width rises to r (r / (r - squash / 2))^SPREAD_POWER.
    """
    link_mm = bundle.link_mm
    node = np.arange(bundle.radius_mm.size, dtype=np.float64)
    near = np.flatnonzero(shape.squash_mm > -film_mm)
    if near.size == 0:
        empty = np.zeros(0)
        return _Dots(empty, empty, empty)
    first = max(0.0, float(near[0]) - 1.0)
    at = np.arange(first, node[-1], STATION_MM / link_mm)
    x, z, phi, radius = (np.interp(at, node, v) for v in (shape.x_mm, shape.z_mm, shape.phi_rad, bundle.radius_mm))
    squash = np.interp(at, node, np.maximum(_smooth(shape.squash_mm, 3.0 / link_mm), 0.0))
    flatter = radius / (radius - 0.5 * np.minimum(squash, 0.9 * radius))
    half_width = wander.spread * radius * flatter**SPREAD_POWER

    # (m, stations): rows are bristles
    outward, across = bristles.outward[:, None], bristles.across[:, None]
    dot_z = z + outward * radius * np.sin(phi)
    dot_x = x - outward * radius * np.cos(phi)
    along = (at - first) / max(node[-1] - first, 1.0)
    bow = (bristles.bow_mm + wander.bow_mm) * along**2
    dot_y = across * half_width + bow + wander.strand_mm[:, None]
    dot_x += bristles.phase_mm[:, None] - wander.reach_mm * along
    ends = (node[-1] - at) * link_mm >= bristles.short_mm[:, None]
    ink = flow[:, None] * np.clip(1.5 * (1.0 - np.maximum(dot_z, 0.0) / film_mm), 0.0, 1.0) * ends
    inked = ink > 0.0
    return _Dots(dot_x[inked], dot_y[inked], ink[inked])


def _scatter(
    dots: _Dots, shape_px: tuple[int, int], origin: tuple[float, float], px_per_mm: float, ink_load: float
) -> Image:
    """Ink offered per area, (h, w): dots spread by the width of a wet hair and its meniscus."""
    h, w = shape_px
    column = np.floor(origin[0] + dots.x_mm * px_per_mm).astype(np.int64).clip(0, w - 1)
    row = np.floor(origin[1] - dots.y_mm * px_per_mm).astype(np.int64).clip(0, h - 1)
    offered = np.bincount(row * w + column, weights=dots.ink, minlength=h * w).reshape(h, w)
    per_mm2 = (offered * px_per_mm**2).astype(np.float32)
    lines = np.asarray(cv2.GaussianBlur(per_mm2, (0, 0), HAIR_MM * px_per_mm), np.float32)
    # hairs that lie on top of each other, as at the tip, hold no more ink between them than the film does
    np.minimum(lines, FULL_PER_MM2, out=lines)
    return np.asarray(cv2.GaussianBlur(lines, (0, 0), (0.04 + 0.18 * ink_load) * px_per_mm), np.float32)


def _soak(wet: Image, ink_load: float, px_per_mm: float, rng: np.random.Generator) -> Image:
    """Ink taken up, (h, w) in 0 .. 1: fibres decide at the edge and, when the brush is dry, everywhere."""
    texture = _paper(wet.shape, px_per_mm, rng)
    # a drier brush wets only the peaks of the paper
    need = (3.5 + 6.0 * (1.0 - ink_load) ** 2) * np.exp((0.2 + 0.9 * (1.0 - ink_load)) * texture)
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


def _smooth(values: Vector, sigma: float) -> Vector:
    """Gaussian smoothing along the spine, ends held."""
    reach = int(np.ceil(3.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)
    held = np.pad(values, reach, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(held, kernel.size) @ (kernel / kernel.sum())
