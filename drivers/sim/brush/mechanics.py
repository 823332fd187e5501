"""The backbone of the simulated brush: a tapered planar elastica pressed on a rigid plane with friction.

Everything here is in mm, N and radians. The plane of bending holds x (the ferrule leans toward +x) and z (up,
paper at 0). The spine is a chain of equal rigid links with torsion springs; its unknowns are the link angles
`phi`, measured from straight down and positive toward -x. Quasi-static loading minimises, per load step,
bending plus squash plus the lagged smoothed-Coulomb potential of incremental potential contact (Li et al.,
ACM TOG 39(4), 2020), by damped Newton.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.spec import BrushSpec

Vector = NDArray[np.float64]

LOAD_STEP_MM = 0.5
"""Largest descent per load step; friction makes the result depend on the path, so this is part of the rig."""
SLIP_SMOOTHING_MM = 0.02
"""Slip at which friction reaches 0.7 of its Coulomb value; Newton needs the corner rounded."""
HARD_CORE = 0.8
"""Squash, as a fraction of the local radius, beyond which the packed hairs turn stiff."""
PACKED_N_PER_MM2 = 1.0
"""Stiffness of the packed bundle: force per mm of length and mm of further squash."""
UPRIGHT_SMOOTHING = 0.01
"""Rounds the kink of |sin phi| so that an upright spine may fall to either side."""
MENISCUS_MM = 0.8
"""Gap over which a meniscus still bridges bundle and paper."""
MAX_NEWTON = 60
ANGLE_TOLERANCE_RAD = 1e-6


@dataclass(frozen=True, slots=True)
class Bundle:
    """Mechanical description of a free bundle cut into n links, ordered from the ferrule to the tip."""

    spec: BrushSpec
    link_mm: float
    radius_mm: Vector
    """(n,) free radius at the far end of each link."""
    joint_n_mm: Vector
    """(n,) torsion stiffness of the joint at the near end of each link, N mm / rad."""
    rest_bend_rad: Vector
    """(n,) rest angle of each joint: the natural set of the bundle."""


@dataclass(frozen=True, slots=True)
class SpineShape:
    """A spine in equilibrium; node j is the far end of link j."""

    x_mm: Vector
    """(n,) node positions along the paper."""
    z_mm: Vector
    """(n,) heights of the bundle's centre line above the paper."""
    phi_rad: Vector
    """(n,) link angles from straight down, positive toward -x."""
    squash_mm: Vector
    """(n,) how far the free cross-section would reach below the paper; negative where it is clear."""
    normal_n: Vector
    """(n,) contact force on each node, upward, without the pull of the menisci."""


def press_spine(bundle: Bundle, depth_mm: float, tilt_rad: float) -> tuple[SpineShape, ...]:
    """The spine after each load step of a descent by `depth_mm`, tilted by `tilt_rad`; the last is final.

    At zero touch the tip of the unloaded bundle is at x = z = 0; the bundle tilts about it, then the ferrule
    moves down.
    """
    steps = max(1, int(np.ceil(depth_mm / LOAD_STEP_MM)))
    return lower_spine(bundle, np.linspace(0.0, depth_mm, steps + 1)[1:], tilt_rad)


def lower_spine(bundle: Bundle, lowered_mm: Iterable[float], tilt_rad: float) -> tuple[SpineShape, ...]:
    """The spine at each of the rising depths `lowered_mm`, which are the load steps of one descent."""
    spine = _Spine(bundle, tilt_rad)
    return tuple(spine.load(0.0, float(lowered)) for lowered in lowered_mm)


def rest_spine(bundle: Bundle, tilt_rad: float) -> SpineShape:
    """The unloaded spine at zero touch."""
    return _Spine(bundle, tilt_rad).shape()


def pull_spine(bundle: Bundle, depth_mm: int, tilt_rad: float) -> tuple[SpineShape, ...]:
    """The spine while the ferrule is drawn toward +x at depths of 1, 2 .. `depth_mm` mm.

    Positions are relative to the ferrule as in `press_spine`. The bundle slides all the time, so the result does
    not depend on how it came down; the ferrule advances half a mm with each load step, and once more at each depth.
    """
    spine, shapes = _Spine(bundle, tilt_rad), list[SpineShape]()
    lowered_mm = [lowered for depth in range(1, depth_mm + 1) for lowered in (depth - 0.5, depth, depth)]
    for count, lowered in enumerate(lowered_mm, 1):
        gone = LOAD_STEP_MM * count
        shape = spine.load(gone, lowered)
        shapes.append(replace(shape, x_mm=shape.x_mm - gone))
    return tuple(shapes[2::3])


class _Spine:
    """A bundle on its way over the paper, from zero touch; it holds how it lay at the end of the last load step."""

    def __init__(self, bundle: Bundle, tilt_rad: float) -> None:
        self.bundle = bundle
        self.tilt_rad = tilt_rad
        self.phi = tilt_rad + np.cumsum(bundle.rest_bend_rad)
        self.start_x = self.clamp_x = bundle.link_mm * float(np.sin(self.phi).sum())
        self.start_z = self.clamp_z = bundle.link_mm * float(np.cos(self.phi).sum())
        self.last_x = self.shape().x_mm
        self.last_normal = np.zeros_like(self.phi)

    def load(self, gone_mm: float, lowered_mm: float) -> SpineShape:
        """Carry out a load step: the ferrule is then so far along +x, and down, from where it was at zero touch."""
        self.clamp_x, self.clamp_z = self.start_x + gone_mm, self.start_z - lowered_mm
        self.phi = self.solve(self.phi)
        shape = self.shape()
        self.last_x, self.last_normal = shape.x_mm, shape.normal_n
        return shape

    def solve(self, phi: Vector) -> Vector:
        """Minimise the energy from `phi` by Newton with a backtracking line search; stops at `MAX_NEWTON`."""
        energy, gradient, hessian = self.derivatives(phi)
        for _ in range(MAX_NEWTON):
            move = -np.linalg.solve(hessian, gradient)
            move *= min(1.0, 0.3 / max(float(np.abs(move).max()), 1e-12))
            slope = float(gradient @ move)
            scale = 1.0
            while self.energy(phi + scale * move) > energy + 1e-4 * scale * slope and scale > 1e-3:
                scale *= 0.5
            phi = phi + scale * move
            if scale * float(np.abs(move).max()) < ANGLE_TOLERANCE_RAD:
                break
            energy, gradient, hessian = self.derivatives(phi)
        return phi

    def shape(self) -> SpineShape:
        """Positions, squash and contact forces as the spine lies."""
        sin = np.sin(self.phi)
        x, z = self._nodes(sin, np.cos(self.phi))
        squash = self.bundle.radius_mm * _broadside(sin) - z
        return SpineShape(x, z, self.phi, squash, np.maximum(0.0, self._contact(squash)[1]))

    def energy(self, phi: Vector) -> float:
        """Bending, squash and lagged friction energy in N mm."""
        sin = np.sin(phi)
        x, z = self._nodes(sin, np.cos(phi))
        bend = self._bend(phi)
        squash = self.bundle.radius_mm * _broadside(sin) - z
        slid = np.hypot(x - self.last_x, SLIP_SMOOTHING_MM)
        stored = 0.5 * self.bundle.joint_n_mm @ bend**2 + self._contact(squash)[0].sum()
        return float(stored + self.bundle.spec.friction * self.last_normal @ slid)

    def derivatives(self, phi: Vector) -> tuple[float, Vector, Vector]:
        """Energy, its gradient (n,) and a Hessian (n, n), without its concave terms if it is not convex."""
        b, n = self.bundle, phi.size
        sin, cos = np.sin(phi), np.cos(phi)
        x, z = self._nodes(sin, cos)
        bend = self._bend(phi)
        broad = _broadside(sin)
        squash = b.radius_mm * broad - z
        stored, normal, stiffness = self._contact(squash)
        slip = x - self.last_x
        slid = np.hypot(slip, SLIP_SMOOTHING_MM)
        limit = b.spec.friction * self.last_normal
        drag = limit * slip / slid
        drag_stiffness = limit * SLIP_SMOOTHING_MM**2 / slid**3

        # rows: nodes, columns: angles; a node moves with every link above it, and `sink` is d(squash)
        above = -b.link_mm * np.tri(n)
        along, sink = above * cos, above * sin
        sink.ravel()[:: n + 1] += b.radius_mm * sin * cos / broad

        torque = b.joint_n_mm * bend
        gradient = torque.copy()
        gradient[:-1] -= torque[1:]
        gradient += sink.T @ normal
        gradient += along.T @ drag
        below_normal = np.cumsum(normal[::-1])[::-1]
        below_drag = np.cumsum(drag[::-1])[::-1]
        section_curve = (cos**2 - sin**2) / broad - (sin * cos) ** 2 / broad**3
        curve = b.link_mm * (sin * below_drag - cos * below_normal) + b.radius_mm * section_curve * normal
        hessian = sink.T @ (np.maximum(stiffness, 0.0)[:, None] * sink)
        hessian += along.T @ (drag_stiffness[:, None] * along)
        spring = b.joint_n_mm
        flat = hessian.ravel()
        diagonal = flat[:: n + 1]
        diagonal += spring + np.append(spring[1:], 0.0)
        flat[1 :: n + 1] -= spring[1:]
        flat[n :: n + 1] -= spring[1:]
        diagonal += curve
        if not _is_convex(hessian):
            diagonal -= np.minimum(curve, 0.0)
        total = float(0.5 * torque @ bend + stored.sum() + b.spec.friction * self.last_normal @ slid)
        return total, gradient, hessian

    def _nodes(self, sin: Vector, cos: Vector) -> tuple[Vector, Vector]:
        """Places of the nodes, given the sines and cosines of the links' angles."""
        ds = self.bundle.link_mm
        return self.clamp_x - ds * np.cumsum(sin), self.clamp_z - ds * np.cumsum(cos)

    def _bend(self, phi: Vector) -> Vector:
        return np.diff(phi, prepend=self.tilt_rad) - self.bundle.rest_bend_rad

    def _contact(self, squash: Vector) -> tuple[Vector, Vector, Vector]:
        """Energy, force and stiffness (n,): soft, then packed, and pulled down when just clear."""
        soft = self.bundle.spec.squash_n_per_mm2 * self.bundle.link_mm
        hard = PACKED_N_PER_MM2 * self.bundle.link_mm
        inside = np.maximum(0.0, squash)
        over = np.maximum(0.0, squash - HARD_CORE * self.bundle.radius_mm)
        # the pull is a parabola over the meniscus, 0 at touch and at its end, so that Newton sees no jump
        gap = np.minimum(np.maximum(-squash / MENISCUS_MM, 0.0), 1.0)
        pull = 8.0 * self.bundle.spec.suction_n_per_mm2 * self.bundle.radius_mm * self.bundle.link_mm
        energy = 0.5 * soft * inside**2 + 0.5 * hard * over**2
        energy += pull * MENISCUS_MM * (gap**2 / 2.0 - gap**3 / 3.0)
        force = soft * inside + hard * over - pull * gap * (1.0 - gap)
        stiffness = soft * (squash > 0.0) + hard * (over > 0.0)
        stiffness += pull / MENISCUS_MM * (1.0 - 2.0 * gap) * ((gap > 0.0) & (gap < 1.0))
        return energy, force, stiffness


def _broadside(sin: Vector) -> Vector:
    """|sin phi|, rounded where the spine is upright: how much of the local radius points at the paper."""
    return np.hypot(sin, UPRIGHT_SMOOTHING)


def _is_convex(hessian: NDArray[np.float64]) -> bool:
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return False
    return True
