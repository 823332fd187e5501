"""The places that the tip goes to, by name, in the base frame: what a picture shows and a check goes over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.paper import to_base, to_paper

Kind = Literal["sheet", "touch", "well", "rim", "pot", "park"]


@dataclass(frozen=True, slots=True)
class Place:
    """Where the tip of the upright brush goes."""

    kind: Kind
    name: str
    at_mm: tuple[float, float, float]
    """In the base frame; z is the lowest height of the tip there."""
    paper_mm: tuple[float, float]
    """The same point in the paper frame, seen from above."""
    top_mm: float
    """Height in the base frame from which the tip comes down to it."""


def places_of(config: RigConfig) -> tuple[Place, ...]:
    """Every place of `rig.toml`, the corners of the sheet first."""
    paper, ink, safe_z_mm = config.paper, config.ink, config.motion.safe_z_mm
    width, height = paper.size_mm
    corners = {
        "sheet lower left": (0.0, 0.0),
        "sheet lower right": (width, 0.0),
        "sheet upper right": (width, height),
        "sheet upper left": (0.0, height),
    }
    deepest_mm = paper.touch_z_mm - config.brush.max_depth_mm
    places = [_over(config, "sheet", name, at, deepest_mm) for name, at in corners.items()]
    places.append(_over(config, "well", "well", ink.well_mm, ink.dip_z_mm))
    if ink.wipe is not None:
        places.append(_over(config, "rim", "wipe, over the rim", ink.wipe.rim_mm, ink.wipe.z_mm))
    if ink.wash is not None:
        places.append(_over(config, "pot", "wash pot", ink.wash.pot_mm, ink.wash.dip_z_mm))
    park = config.motion.park_mm
    at = to_paper(paper, park[0], park[1])
    places.append(Place("park", "park", park, at, max(park[2], safe_z_mm)))
    touched = config.touch.points_mm or [paper.touch_point_mm]
    places += [
        _over(config, "touch", f"touch point {number}", point, paper.touch_z_mm)
        for number, point in enumerate(touched, 1)
    ]
    return tuple(places)


def _over(config: RigConfig, kind: Kind, name: str, paper_mm: tuple[float, float], z_mm: float) -> Place:
    at_mm = (*to_base(config.paper, *paper_mm), z_mm)
    return Place(kind, name, at_mm, paper_mm, config.motion.safe_z_mm)
