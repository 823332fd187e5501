"""The constants of one individual simulated brush, with their allowed ranges."""

from dataclasses import dataclass, field, fields
from typing import Any


def _ranged(default: float, low: float, high: float) -> Any:
    """A constant with its allowed range."""
    return field(default=default, metadata={"range": (low, high)})


@dataclass(frozen=True, slots=True)
class BrushSpec:
    """Properties of one individual brush; raises ValueError, naming value and range, if one is out of range."""

    radius_mm: float = _ranged(6.0, 1.0, 20.0)
    """Largest radius of the bundle."""
    length_mm: float = _ranged(48.0, 3.0, 120.0)
    """Free length of the bundle, ferrule to tip."""
    stiffness_n_mm2: float = _ranged(200.0, 10.0, 1000.0)
    """Flexural rigidity of the wet bundle where it is thickest, N times mm^2."""
    stiffness_power: float = _ranged(3.5, 2.0, 4.0)
    """Rigidity falls with this power of the local radius: 4 = a solid rod, 2 = hairs that slide freely."""
    squash_n_per_mm2: float = _ranged(0.008, 0.001, 0.5)
    """Sideways stiffness of the bundle: force per mm of length and mm of squash."""
    suction_n_per_mm2: float = _ranged(0.003, 0.0, 0.01)
    """Peak capillary stress that draws the wet bundle down: 2 x 0.072 N/m over pores of 0.05 mm radius."""
    friction: float = _ranged(0.22, 0.0, 0.8)
    """Coulomb coefficient of wet hair on paper. From about 0.35 an upright tip sticks where it touched."""
    set_deg: float = _ranged(8.0, 1.0, 30.0)
    """Set of the tip half toward -x, from the last wipe; never 0, or an upright brush stands on its tip."""
    belly_share: float = _ranged(0.3, 0.1, 0.7)
    """Share of the length, from the ferrule, over which the bundle stays thick; it tapers from there to the tip."""
    taper_power: float = _ranged(0.85, 0.5, 3.0)
    """Shape of the taper: 1 = a cone, less = hollow, more = full like a bullet."""
    splay_power: float = _ranged(1.7, 1.0, 4.0)
    """Half width of a flattened section as a power of its mean flattening: 1 keeps its area, more lets hairs part."""
    splay_reach_mm: float = _ranged(3.0, 1.0, 12.0)
    """Distance along the hairs over which they stay parted beside a flattened section, standard deviation."""
    film_mm: float = _ranged(0.5, 0.12, 2.0)
    """Height over the paper within which a freshly dipped hair gives ink."""
    uneven_mm: float = _ranged(4.0, 0.0, 12.0)
    """How far short of the tip the outer hairs end, standard deviation."""
    wick_mm: float = _ranged(0.22, 0.04, 1.0)
    """Capillary spread of a full brush's ink in the paper, standard deviation."""
    need_per_mm2: float = _ranged(3.5, 0.5, 15.0)
    """Deposits per area below which the paper stays white under a full brush."""
    trail_share: float = _ranged(1.0, 0.0, 1.0)
    """Ink that hairs leave while they slide down, as a share of what they leave where they rest: ink needs time."""
    bow_mm: float = _ranged(0.25, 0.0, 3.0)
    """Sideways offset of the pressed tip, standard deviation between brushes."""
    spread_wander: float = _ranged(0.015, 0.0, 0.3)
    """Relative width, standard deviation between presses."""
    reach_wander_mm: float = _ranged(0.15, 0.0, 3.0)
    """Extra reach of the tip along the paper, standard deviation between presses."""
    bow_wander_mm: float = _ranged(0.12, 0.0, 3.0)
    """Sideways offset of the tip, standard deviation between presses."""
    place_wander_mm: float = _ranged(0.0, 0.0, 3.0)
    """Offset of the whole mark in x and in y, standard deviation between presses: the bundle hangs a little aside."""
    strand_mm: float = _ranged(0.06, 0.0, 1.0)
    """Sideways stray of each hair, standard deviation in each press."""
    bristles: int = _ranged(400, 50, 5000)
    """Number of hairs simulated one by one; each stands for several real ones."""
    seed: int = _ranged(1, 0, 2**63 - 1)
    """Seed of the individual: its bristles and how they clump."""

    def __post_init__(self) -> None:
        for name, (low, high) in ALLOWED.items():
            within(name, getattr(self, name), low, high)
        within("length_mm", self.length_mm, 3.0 * self.radius_mm, 120.0)


ALLOWED: dict[str, tuple[float, float]] = {constant.name: constant.metadata["range"] for constant in fields(BrushSpec)}
"""Range of each constant of a `BrushSpec`; a bundle is also at least three times as long as it is thick."""


def within(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError, naming value and range, unless `low` <= `value` <= `high`."""
    if not low <= value <= high:
        raise ValueError(f"{name} = {value:g} is outside {low:g} .. {high:g}")
