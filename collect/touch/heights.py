"""Heights of the paper: how far touches may go and where they mark it, what they found, and the plane through them."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import PaperConfig, TouchConfig
from brushloop.collect.rig.paper import PaperPlane, Sheet, fit_plane
from brushloop.sessions.events import TouchedPoint, ZeroTouchResult

SPAN_SIGMAS = 5.0
"""Three touches at one height span more than this many of their standard errors only once in a thousand times."""


@dataclass(frozen=True, slots=True)
class Reach:
    """An approach: where it begins, where the paper is expected, and where it ends; heights in the base frame."""

    start_z_mm: float
    expected_z_mm: float
    lowest_z_mm: float


def lowest_z_mm(paper: PaperConfig, config: TouchConfig, x_mm: float, y_mm: float, extent_mm: float = 0.0) -> float:
    """The height below which no touch goes: the end of an approach from the taught height.

    It does not depend on earlier touches, so that a plan can be checked against it before anything is touched.
    """
    return paper.touch_z_mm - config.travel_mm - _unknown_mm(config, paper.touch_point_mm, x_mm, y_mm, extent_mm)


class KnownHeights:
    """Heights of the paper that are known so far; at first the taught one, at the place where it was taught."""

    def __init__(self, paper: PaperConfig, config: TouchConfig) -> None:
        self._paper = paper
        self._config = config
        self._heights = [(paper.touch_point_mm, paper.touch_z_mm)]

    def add(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Add a touch."""
        self._heights.append(((x_mm, y_mm), z_mm))

    def reach(self, x_mm: float, y_mm: float, extent_mm: float = 0.0) -> Reach:
        """The approach at a point: around the nearest known height, extended by how far the sheet may lean in between.

        `extent_mm` is how far from the point the touches of its approach may lie.
        """
        place, z_mm = min(self._heights, key=lambda known: math.dist((x_mm, y_mm), known[0]))
        unknown_mm = _unknown_mm(self._config, place, x_mm, y_mm, extent_mm)
        lowest_mm = lowest_z_mm(self._paper, self._config, x_mm, y_mm, extent_mm)
        return Reach(
            z_mm + self._config.above_mm + unknown_mm,
            z_mm,
            max(z_mm - self._config.travel_mm - unknown_mm, lowest_mm),
        )


def _unknown_mm(
    config: TouchConfig, known_mm: tuple[float, float], x_mm: float, y_mm: float, extent_mm: float
) -> float:
    """How far the sheet may rise or fall within a distance of a point whose height is known."""
    return math.tan(math.radians(config.lean_deg)) * (math.dist((x_mm, y_mm), known_mm) + extent_mm)


@dataclass(frozen=True, slots=True)
class Touch:
    """One touch: where (paper frame), the height of the tip (base frame), and its standard error where one is known."""

    x_mm: float
    y_mm: float
    z_mm: float
    sigma_mm: float | None = None


def at_one_point(touches: list[Touch], config: TouchConfig, guide: PaperPlane | None = None) -> TouchedPoint:
    """The mean of the touches of one point. Raises `StepError` if they span more than their own errors explain.

    `guide` is the known lean of the sheet, for touches that lie some millimetres apart.
    """
    lean = guide or PaperPlane(0.0)
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


def taught(paper: PaperConfig, rests_mm: float) -> ZeroTouchResult:
    """The level plane at the taught height, which was visited and not measured; the arm rested at `rests_mm`."""
    visited = at_one_point([Touch(*paper.touch_point_mm, rests_mm)], TouchConfig())
    return ZeroTouchResult(method="taught", touch_z_mm=paper.touch_z_mm, residuals_mm=(0.0,), points=(visited,))


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


COARSE_STEP_MM, FINE_STEP_MM = 0.5, 0.08
"""Steps of the rows of touches by camera; the error of a touch is about half of a fine step."""
PITCH_MM, COLUMNS = 4.0, 9
"""Distance between spots, and spots in a row of a point's patch: a shallow touch leaves a mark of one to three
millimetres, and camera and arm must agree on the place within a quarter of the pitch."""
EXTENT_MM = (COLUMNS - 1) * PITCH_MM
SPOTS_PER_PHOTO = 2
"""Touches per photograph in the coarse row, which ends when ink is seen; few, so that spots stay small."""
SLACK_STEPS = 2
"""Fine steps beyond the coarse step, on either side: a coarse touch is accurate only to its step."""
FINE_COUNT = 1 + 2 * SLACK_STEPS + math.ceil(COARSE_STEP_MM / FINE_STEP_MM)
"""Spots of one fine row."""


def spots(at_mm: tuple[float, float], sheet_mm: tuple[float, float]) -> Iterator[tuple[float, float]]:
    """Fresh spots around one point, to and fro from the lower left, so that consecutive touches are neighbours.

    Raises `StepError` where the next one does not lie on the sheet.
    """
    for number in itertools.count():
        row, column = divmod(number, COLUMNS)
        column = COLUMNS - 1 - column if row % 2 else column
        x_mm, y_mm = at_mm[0] + column * PITCH_MM, at_mm[1] + row * PITCH_MM
        if not (0.0 <= x_mm <= sheet_mm[0] and 0.0 <= y_mm <= sheet_mm[1]):
            raise StepError(
                f"the touches at ({at_mm[0]:g}, {at_mm[1]:g}) mm do not fit on the sheet: "
                f"spot {number + 1} would lie at ({x_mm:g}, {y_mm:g}) mm"
            )
        yield x_mm, y_mm


def coarse_count(reach: Reach) -> int:
    """Spots of a whole coarse row, which ends early where ink is seen; all of them are photographed."""
    heights = math.ceil((reach.start_z_mm - reach.lowest_z_mm) / COARSE_STEP_MM) + 1
    return math.ceil(heights / SPOTS_PER_PHOTO) * SPOTS_PER_PHOTO


MARK_MM = 3.0
"""Half the side of the paper that one mark may cover; a shallow touch leaves less."""
Rect = tuple[float, float, float, float]
"""x, y, width, height in the paper frame."""


def touch_rects(paper: PaperConfig, config: TouchConfig) -> list[Rect]:
    """Where a measured zero touch lowers the tip: at points or, by camera, in a patch around each point."""
    match config.method:
        case "taught":
            return []
        case "force" | "jog":
            return [(x, y, 0.0, 0.0) for x, y in config.points_mm or [paper.touch_point_mm]]
        case "camera":
            rows = [math.ceil(spots / COLUMNS) for spots in patch_spots(paper, config)]
            return [
                (x, y, EXTENT_MM, (count - 1) * PITCH_MM) for (x, y), count in zip(config.points_mm, rows, strict=True)
            ]


def patch_spots(paper: PaperConfig, config: TouchConfig) -> list[int]:
    """The most spots that each point's patch may take."""
    known = KnownHeights(paper, config)
    reaches = [known.reach(x, y, EXTENT_MM) for x, y in config.points_mm]
    return [coarse_count(reach) + config.touches * FINE_COUNT for reach in reaches]


def used_patches(sheet: Sheet, paper: PaperConfig, config: TouchConfig) -> set[int]:
    """The patches whose middle parts zero touch may ink; none for the taught height.

    A patch counts if a mark reaches more than `MARK_MM` into it: touch points in the sheet's margin cost no patch.
    """
    m = MARK_MM
    rects = [(x - m, y - m, w + 2 * m, h + 2 * m) for x, y, w, h in touch_rects(paper, config)]
    patches = [sheet.patch(index) for index in range(sheet.capacity)]
    return {patch.index for patch in patches for rect in rects if _reaches_into(rect, patch.rect_mm)}


def _reaches_into(rect: Rect, patch: Rect) -> bool:
    (ax, ay, aw, ah), (bx, by, bw, bh) = rect, patch
    across, along = min(ax + aw, bx + bw) - max(ax, bx), min(ay + ah, by + bh) - max(ay, by)
    return across > MARK_MM and along > MARK_MM
