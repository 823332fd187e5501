"""Zero touch as one step: the plane from which H is counted, by the method of the configuration; and touches by jog."""

from __future__ import annotations

import math
from collections.abc import Callable

from brushloop.collect.errors import NeedsOperator, StepError
from brushloop.collect.motion import Dip, Procedures, over, slowly
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.photograph.measure import Point, Rect
from brushloop.collect.rig.config import PaperConfig, TouchConfig
from brushloop.collect.rig.paper import Sheet
from brushloop.collect.touch.camera import COLUMNS, EXTENT_MM, PITCH_MM, FirstInkTouch, most_spots
from brushloop.collect.touch.force import Average, Spring, resting, touch_by_force
from brushloop.collect.touch.heights import KnownHeights, Reach, Touch, at_one_point, through
from brushloop.sessions.events import TouchedPoint, ZeroTouchResult


async def measure_plane(
    procedures: Procedures,
    config: TouchConfig,
    *,
    dip: Dip,
    average: Average,
    asker: Asker,
    tell: Callable[[str], None],
) -> ZeroTouchResult:
    """Touch as configured and fit the plane. The arm begins and ends at travel height.

    `dip` fills the brush. `average` is of the force sensor, which must have been set to zero with nothing touching.
    `asker` asks the operator for each jog, `tell` reports progress. Raises `StepError`, with the figures, if nothing is
    touched, touches do not repeat, or the points do not lie in a plane, and `NeedsOperator` if nobody can jog or the
    operator gives up; the brush is lifted then, too.
    """
    paper = procedures.rig.config.paper
    if config.method == "taught":
        visited = at_one_point([Touch(*paper.touch_point_mm, await procedures.zero_touch())], config)
        # That height was visited, and not measured.
        return ZeroTouchResult(method="taught", touch_z_mm=paper.touch_z_mm, residuals_mm=(0.0,), points=(visited,))
    points_mm = config.points_mm or [paper.touch_point_mm]
    if config.method == "force" and procedures.rig.force is None:
        raise StepError("zero touch by force needs a force sensor: [force] is missing")
    async with procedures.lifted_after():
        if config.method == "camera":
            points = await FirstInkTouch(procedures, config, dip).measure(points_mm)
        else:
            points = await _by_force_or_jog(procedures, config, points_mm, average, asker, tell)
    return through(points, config)


async def _by_force_or_jog(
    procedures: Procedures,
    config: TouchConfig,
    points_mm: list[Point],
    average: Average,
    asker: Asker,
    tell: Callable[[str], None],
) -> list[TouchedPoint]:
    rig = procedures.rig.config
    known, points = KnownHeights(rig.paper, config), list[TouchedPoint]()
    spring: Spring | None = None
    for point in points_mm:
        reach, touches = known.reach(*point), list[Touch]()
        rest = resting(procedures, average, point, config)
        await procedures.go(over(rig, *point), slowly(rig, *point, reach.start_z_mm))
        for count in range(len(points) * config.touches + 1, (len(points) + 1) * config.touches + 1):
            name = f"touch {count} of {len(points_mm) * config.touches}"
            if config.method == "jog":
                touches.append(Touch(*point, await _jogged(procedures, config, asker, name, point, reach)))
                continue
            tell(f"zero touch by force: {name}: down until the force shows the paper")
            near_z_mm = touches[-1].z_mm if touches else None
            contact = await touch_by_force(rest, reach, config.force, spring, near_z_mm)
            touches.append(Touch(*point, contact.z_mm, contact.sigma_mm))
            spring = contact.spring.next()
        await procedures.lift()
        points.append(at_one_point(touches, config))
        known.add(*point, points[-1].z_mm)
    return points


JOG_MM = {"1": -1.0, "2": -0.1, "3": -0.02, "8": 0.02, "9": 0.1, "0": 1.0}
"""Step of each key, positive up."""
TOUCHES, GIVE_UP = "t", "x"
JOG_CHOICES = (
    *(Choice(key, f"{'down' if step < 0 else 'up'} {abs(step):g} mm") for key, step in JOG_MM.items()),
    Choice(TOUCHES, "the tip just touches"),
    Choice(GIVE_UP, "give up: the height of the paper stays unchanged"),
)
ROUNDING_MM = 1e-6


async def _jogged(
    procedures: Procedures, config: TouchConfig, asker: Asker, name: str, point: Point, reach: Reach
) -> float:
    """The height at which the operator said that the tip touches, in mm; the brush is left there.

    A step beyond either end of the approach is shortened. Raises `NeedsOperator` if the operator gives up.
    """
    z_mm = reach.start_z_mm
    while True:
        rests_mm = await procedures.lower(*point, z_mm, config.speed_mm_s)
        question = (
            f"{name.capitalize()}. Jog until the tip just touches the paper at ({point[0]:g}, {point[1]:g}) mm. "
            f"The tip is {rests_mm - reach.expected_z_mm:+.2f} mm from the expected height."
        )
        if z_mm <= reach.lowest_z_mm + ROUNDING_MM:
            question += " The tip goes no lower: if nothing touches, give up and correct touch_z_mm in rig.toml."
        key = await asker.ask(Prompt(question, JOG_CHOICES, GIVE_UP))
        if key == GIVE_UP:
            raise NeedsOperator(f"the operator gave up at {name}")
        if key == TOUCHES:
            return rests_mm
        z_mm = min(max(z_mm + JOG_MM[key], reach.lowest_z_mm), reach.start_z_mm)


# What a plan has to know before anything is touched


MARK_MM = 3.0
"""Half the side of the paper that one mark may cover; a shallow touch leaves less."""


def touched_regions(paper: PaperConfig, config: TouchConfig) -> list[tuple[Rect, float]]:
    """Where a measured zero touch may lower the tip, and how low, in mm of the base frame: over points or, by camera,
    over a patch around each point; nowhere for the taught height."""
    if config.method == "taught":
        return []
    if config.method == "camera":
        patches = zip(config.points_mm, most_spots(paper, config), strict=True)
        return [
            ((x, y, EXTENT_MM, (math.ceil(count / COLUMNS) - 1) * PITCH_MM), reach.lowest_z_mm)
            for (x, y), (reach, count) in patches
        ]
    known, points_mm = KnownHeights(paper, config), config.points_mm or [paper.touch_point_mm]
    return [((x, y, 0.0, 0.0), known.reach(x, y).lowest_z_mm) for x, y in points_mm]


def used_patches(sheet: Sheet, paper: PaperConfig, config: TouchConfig) -> set[int]:
    """The patches whose middle parts zero touch may ink; none for the taught height.

    A patch counts if a mark reaches more than `MARK_MM` into it: touch points in the sheet's margin cost no patch.
    """
    m = MARK_MM
    rects = [(x - m, y - m, w + 2 * m, h + 2 * m) for (x, y, w, h), _ in touched_regions(paper, config)]
    patches = [sheet.patch(index) for index in range(sheet.capacity)]
    return {patch.index for patch in patches for rect in rects if _reaches_into(rect, patch.rect_mm)}


def _reaches_into(rect: Rect, patch: Rect) -> bool:
    (ax, ay, aw, ah), (bx, by, bw, bh) = rect, patch
    across, along = min(ax + aw, bx + bw) - max(ax, bx), min(ay + ah, by + bh) - max(ay, by)
    return across > MARK_MM and along > MARK_MM
