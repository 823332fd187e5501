"""Heights of the paper: how far touches may go, what they found, and the plane through them."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import PaperConfig, TouchConfig
from brushloop.collect.rig.paper import PaperPlane, fit_plane
from brushloop.sessions.events import TouchedPoint, ZeroTouchResult

SPAN_SIGMAS = 5.0
"""Three touches at one height span more than this many of their standard errors only once in a thousand times."""
LEVEL = PaperPlane(0.0)


@dataclass(frozen=True, slots=True)
class Reach:
    """An approach: where it begins, where the paper is expected, and where it ends; heights in the base frame."""

    start_z_mm: float
    expected_z_mm: float
    lowest_z_mm: float


class KnownHeights:
    """Heights of the paper that are known so far; at first the taught one, at the place where it was taught."""

    def __init__(self, paper: PaperConfig, config: TouchConfig, extent_mm: float = 0.0) -> None:
        """`extent_mm` is how far from a point the touches of its approach may lie."""
        self._config = config
        self._extent_mm = extent_mm
        self._heights = [(paper.touch_point_mm, paper.touch_z_mm)]

    def add(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Add a touch."""
        self._heights.append(((x_mm, y_mm), z_mm))

    def reach(self, x_mm: float, y_mm: float) -> Reach:
        """The approach at a point: around the nearest known height, extended by how far the sheet may lean in between.

        Whatever was touched, it ends no lower than an approach from the taught height, so that a plan can be checked
        against that before anything is touched.
        """
        rise = math.tan(math.radians(self._config.lean_deg))

        def unknown_mm(known_mm: tuple[float, float]) -> float:
            return rise * (math.dist((x_mm, y_mm), known_mm) + self._extent_mm)

        place, z_mm = min(self._heights, key=lambda known: math.dist((x_mm, y_mm), known[0]))
        ends_mm = [z - self._config.travel_mm - unknown_mm(at) for at, z in (self._heights[0], (place, z_mm))]
        return Reach(z_mm + self._config.above_mm + unknown_mm(place), z_mm, max(ends_mm))


@dataclass(frozen=True, slots=True)
class Touch:
    """One touch: where (paper frame), the height of the tip (base frame), and its standard error where one is known."""

    x_mm: float
    y_mm: float
    z_mm: float
    sigma_mm: float | None = None


def at_one_point(touches: list[Touch], config: TouchConfig, lean: PaperPlane = LEVEL) -> TouchedPoint:
    """The mean of the touches of one point. Raises `StepError` if they span more than their own errors explain.

    `lean` is the known lean of the sheet, for touches that lie some millimetres apart.
    """
    heights = [t.z_mm - lean.touch_z_mm(t.x_mm, t.y_mm) for t in touches]
    span_mm = max(heights) - min(heights)
    limit_mm = max(config.repeatability_mm, SPAN_SIGMAS * max(t.sigma_mm or 0.0 for t in touches))
    if span_mm > limit_mm:
        listed = ", ".join(f"{t.z_mm:.3f}" for t in touches)
        raise StepError(
            f"zero touch does not repeat at ({touches[0].x_mm:.0f}, {touches[0].y_mm:.0f}) mm: the heights {listed} mm "
            f"span {span_mm:.3f} mm, limit {limit_mm:.3g} mm. Is the paper flat and the brush firm?"
        )
    return TouchedPoint(
        x_mm=statistics.fmean(t.x_mm for t in touches),
        y_mm=statistics.fmean(t.y_mm for t in touches),
        z_mm=statistics.fmean(t.z_mm for t in touches),
        span_mm=span_mm,
        touches_mm=tuple(t.z_mm for t in touches),
        sigma_mm=tuple(t.sigma_mm for t in touches),
    )


def through(points: list[TouchedPoint], config: TouchConfig) -> ZeroTouchResult:
    """The plane through the points. Raises `StepError` if one lies too far from it, or it leans too much."""
    plane, residuals_mm = fit_plane([(point.x_mm, point.y_mm, point.z_mm) for point in points])
    if max(map(abs, residuals_mm)) > config.residual_mm:
        listed = ", ".join(f"{r:+.3f}" for r in residuals_mm)
        raise StepError(
            f"the touched points do not lie in a plane: residuals {listed} mm, limit {config.residual_mm:g} mm. "
            "Does the sheet lie flat?"
        )
    return ZeroTouchResult(
        method=config.method,
        touch_z_mm=plane.z0_mm,
        slope_x=plane.slope_x,
        slope_y=plane.slope_y,
        slope_deg=plane.slope_deg,
        residuals_mm=residuals_mm,
        points=tuple(points),
    )


def plane_of(touched: ZeroTouchResult) -> PaperPlane:
    """The plane from which H is counted after that zero touch."""
    return PaperPlane(touched.touch_z_mm, touched.slope_x, touched.slope_y)
