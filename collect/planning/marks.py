"""How far a mark is likely to reach, by the closed-form stroke model: a warning's worth, not a measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass

from collect.rig.config import BrushConfig


@dataclass(frozen=True, slots=True)
class Reach:
    """Of a mark from its zero-touch point, in mm: along the heading, against it, and to either side."""

    ahead_mm: float
    behind_mm: float
    side_mm: float


def reach_of(brush: BrushConfig, depth_mm: float, tilt_deg: float) -> Reach:
    """CCD-BSM, Eq. 1-5, with lambda = pi: theta = atan(R / L), O3A = H (tan a - tan(a - theta)),
    O4O3 = H / cos(a - theta) + O3A, O3C = H R / (L cos a). The mark lies from -O4O3 to O3A, pi O3C to each side.
    """
    alpha, theta = math.radians(tilt_deg), math.atan2(brush.radius_mm, brush.length_mm)
    depth_mm = max(depth_mm, 0.0)
    o3a = depth_mm * (math.tan(alpha) - math.tan(alpha - theta))
    o4o3 = depth_mm / math.cos(alpha - theta) + o3a
    o3c = depth_mm * brush.radius_mm / (brush.length_mm * math.cos(alpha))
    return Reach(o3a, o4o3, math.pi * o3c)
