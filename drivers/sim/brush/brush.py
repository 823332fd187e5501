"""The simulated brush: one individual brush, whose marks come from mechanics and not from a stroke model.

`drivers/sim/brush/mechanics.py` bends the bundle of hairs, `footprint.py` prints what then lies on the paper.
`docs/loopback-brush.md` gives the equations and their sources, and says what this brush is not.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.drag import Stances, Waypoint, draw_drag
from brushloop.drivers.sim.brush.footprint import (
    FLAWLESS,
    PX_PER_MM,
    Flaw,
    Footprint,
    Trouble,
    blank_footprint,
    draw_trouble,
    grow_bristles,
    print_footprint,
    wet_tuft,
)
from brushloop.drivers.sim.brush.mechanics import (
    LOAD_STEP_MM,
    Bundle,
    SpineShape,
    Vector,
    lower_spine,
    press_spine,
    pull_spine,
    rest_spine,
)
from brushloop.drivers.sim.brush.misfit import Misfit
from brushloop.drivers.sim.brush.spec import BrushSpec, within

LINKS = 48
LEAST_DEPTH_MM = 1e-6
"""A drag no deeper than this leaves no mark."""
MAX_TILT_DEG = 30.0
MAX_DEPTH = 0.9
"""Deepest press as a fraction of the ferrule's height at zero touch; beyond it the ferrule hits the paper."""

Descent = tuple[SpineShape, ...]
"""The spine after each load step on the way down; the last is final."""
LIE, PAPER, TROUBLE = range(3)
"""Streams of random numbers of a press, so that the paper does not change with the number of bristles."""
REMEMBERED_SPINES = 64
REMEMBERED_STANCES = 8


class Brush:
    """One brush; a twin also has a misfit. Pressing has no memory: each press starts from the same wiped bundle."""

    def __init__(self, spec: BrushSpec, misfit: Misfit | None = None) -> None:
        self.spec, self.misfit = spec, misfit
        self._bundle = _bundle(spec)
        self._bristles = grow_bristles(spec, np.random.default_rng(spec.seed))

    def press(
        self,
        depth_mm: float,
        tilt_deg: float,
        *,
        ink_load: float,
        press_seed: int,
        flaw: Flaw | None = None,
        severity: float = 1.0,
    ) -> Footprint:
        """Press once on fresh paper; equal arguments give equal bytes, another `press_seed` another natural repeat.

        The frame's origin is where the tip touched; the brush tilts about it until the ferrule leans toward
        +x by `tilt_deg` and then descends. Columns grow with +x, rows with -y. The upright bundle bends
        toward -x, its set. A depth of 0 or less leaves the paper blank; a flaw of severity 0 has no effect. Raises
        ValueError, naming value and range, if `depth_mm` exceeds 0.9 length cos(tilt), or tilt is outside
        0 .. 30 deg, or `ink_load` outside 0 .. 1 (1 = freshly dipped).
        """
        self._check(depth_mm, tilt_deg, ink_load)
        if depth_mm <= 0.0:
            return blank_footprint()
        trouble = FLAWLESS
        if flaw is not None and severity > 0.0:
            rng = self._rng(press_seed, TROUBLE)
            trouble = draw_trouble(flaw, severity, self.spec.bristles, self.spec.length_mm, rng)
        spine = _spine(self.spec, float(depth_mm), float(tilt_deg))
        mark = self.print_descent(spine, ink_load=ink_load, press_seed=press_seed, trouble=trouble)
        return mark if self.misfit is None else self.misfit.bend(mark, depth_mm, tilt_deg)

    def descents(self, depths_mm: Sequence[float], tilt_deg: float) -> dict[float, Descent]:
        """The way down to each of the depths, all taken from one descent to the deepest, which is quicker than many.

        The load steps end at multiples of half a mm and at each depth; `press` divides each way into equal steps, so
        that the shapes differ slightly where a depth is not such a multiple. Raises ValueError as `press` does.
        """
        for depth in depths_mm:
            within("depth_mm", depth, LEAST_DEPTH_MM, self.deepest_mm(tilt_deg))
        grid = LOAD_STEP_MM * np.arange(1, math.ceil(max(depths_mm) / LOAD_STEP_MM))
        lowered = np.union1d(grid, np.asarray(depths_mm, np.float64))
        path = lower_spine(self._bundle, lowered, math.radians(tilt_deg))
        steps = list(zip(lowered, np.isin(lowered, grid), path, strict=True))
        return {
            depth: tuple(shape for at, on_grid, shape in steps if at == depth or (on_grid and at < depth))
            for depth in depths_mm
        }

    def print_descent(
        self,
        descent: Descent,
        *,
        ink_load: float,
        press_seed: int,
        px_per_mm: float = PX_PER_MM,
        trouble: Trouble = FLAWLESS,
    ) -> Footprint:
        """The mark that the mechanics leave after a descent, as `press` prints it."""
        tuft = wet_tuft(self._bundle, self._bristles, trouble, self._rng(press_seed, LIE))
        return print_footprint(descent, tuft, ink_load, px_per_mm, self._rng(press_seed, PAPER))

    @property
    def set_lean_deg(self) -> float:
        """Lean of the ferrule that would carry the tip of a straight bundle as far aside as the set carries it.

        The mean of the set's angle over the length: a sixth of `set_deg`, because the set lies in the outer half.
        """
        return math.degrees(float(np.cumsum(self._bundle.rest_bend_rad).mean()))

    def deepest_mm(self, tilt_deg: float) -> float:
        """Depth at which the ferrule is about to hit the paper."""
        return MAX_DEPTH * self.spec.length_mm * math.cos(math.radians(min(tilt_deg, MAX_TILT_DEG)))

    def push_n(self, depth_mm: float, tilt_deg: float) -> Vector:
        """Normal force in N at equally spaced depths from 0 to `depth_mm`, on the way down."""
        path = _spine(self.spec, depth_mm, tilt_deg)
        return np.array([0.0, *(float(shape.normal_n.sum()) for shape in path)])

    def drag(
        self, path: Sequence[Waypoint], tilt_deg: float, heading_deg: float, *, ink_load: float, press_seed: int
    ) -> Footprint:
        """Draw the brush along straight lines between waypoints; equal arguments give equal bytes.

        The mark's frame lies along the paper's: its origin is the first waypoint, columns grow with +x, rows with -y.
        `heading_deg` is where the ferrule leans, or would lean, when the tip lands; from there on the bundle trails.
        Raises ValueError as `press` does. If no depth exceeds 0, the paper stays blank.
        """
        deepest = max(w.depth_mm for w in path)
        self._check(deepest, tilt_deg, ink_load)
        if deepest <= LEAST_DEPTH_MM:
            return blank_footprint()
        stances = _stances(self.spec, math.ceil(deepest), float(tilt_deg))
        tuft = wet_tuft(self._bundle, self._bristles, FLAWLESS, self._rng(press_seed, LIE))
        return draw_drag(path, stances, math.radians(heading_deg), tuft, ink_load, self._rng(press_seed, PAPER))

    def _check(self, depth_mm: float, tilt_deg: float, ink_load: float) -> None:
        within("tilt_deg", tilt_deg, 0.0, MAX_TILT_DEG)
        within("ink_load", ink_load, 0.0, 1.0)
        within("depth_mm", depth_mm, -math.inf, self.deepest_mm(tilt_deg))

    def _rng(self, press_seed: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.spec.seed, press_seed, stream])


@lru_cache(maxsize=REMEMBERED_SPINES)
def _spine(spec: BrushSpec, depth_mm: float, tilt_deg: float) -> Descent:
    """The way down; it depends on brush, depth and tilt only, and a protocol repeats its conditions."""
    return press_spine(_bundle(spec), depth_mm, math.radians(tilt_deg))


@lru_cache(maxsize=REMEMBERED_STANCES)
def _stances(spec: BrushSpec, depth_mm: int, tilt_deg: float) -> Stances:
    bundle, tilt_rad = _bundle(spec), math.radians(tilt_deg)
    return Stances(
        (rest_spine(bundle, tilt_rad), *press_spine(bundle, depth_mm, tilt_rad)),
        (rest_spine(bundle, tilt_rad), *pull_spine(bundle, depth_mm, tilt_rad)),
        float(depth_mm),
    )


def _bundle(spec: BrushSpec) -> Bundle:
    """Cut the free bundle into `LINKS` links and give each joint its share of rigidity and set."""
    link = spec.length_mm / LINKS
    joint_mm = link * np.arange(LINKS)
    rigidity = spec.stiffness_n_mm2 * (_profile(spec, joint_mm) / spec.radius_mm) ** spec.stiffness_power
    share = np.clip(joint_mm / spec.length_mm - 0.5, 0.0, None)
    return Bundle(
        spec,
        link_mm=link,
        radius_mm=_profile(spec, joint_mm + link),
        joint_n_mm=rigidity / link,
        rest_bend_rad=math.radians(spec.set_deg) * share / share.sum(),
    )


def _profile(spec: BrushSpec, from_ferrule_mm: NDArray[np.floating]) -> Vector:
    """Free radius along the bundle: a slight belly, then a taper to a fine tip."""
    u = np.asarray(from_ferrule_mm / spec.length_mm, np.float64)
    belly = spec.belly_share
    root = 0.95 + 0.05 * np.sin(0.5 * np.pi * np.minimum(u / belly, 1.0))
    taper = 1.0 - np.clip((u - belly) / (1.0 - belly), 0.0, 1.0) ** spec.taper_power
    return spec.radius_mm * np.maximum(np.where(u < belly, root, taper), 0.04)
