"""Zero touch as one step: the plane from which H is counted, by the method of the configuration; and touches by jog."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from brushloop.collect.errors import NeedsOperator, StepError
from brushloop.collect.motion import Dip, Procedures
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.rig.config import TouchConfig
from brushloop.collect.touch.camera import FirstInkTouch
from brushloop.collect.touch.force import ForceTap, Rest, Spring, resting, touch_by_force
from brushloop.collect.touch.heights import KnownHeights, Reach, Touch, at_one_point, taught, through
from brushloop.sessions.events import TouchedPoint, ZeroTouchResult


async def measure_plane(
    procedures: Procedures,
    config: TouchConfig,
    *,
    dip: Dip,
    tap: ForceTap,
    asker: Asker,
    tell: Callable[[str], None],
) -> ZeroTouchResult:
    """Touch as configured and fit the plane. The arm begins and ends at travel height.

    `dip` fills the brush. `tap` receives every sample of the force sensor, which must have been set to zero with
    nothing touching. `asker` asks the operator for each jog, `tell` reports progress. Raises `StepError`, with the
    figures, if nothing is touched, touches do not repeat, or the points do not lie in a plane, and `NeedsOperator` if
    nobody can jog or the operator gives up; the brush is lifted then, too.
    """
    paper = procedures.rig.config.paper
    points_mm = config.points_mm or [paper.touch_point_mm]
    if config.method == "taught":
        return taught(paper, await procedures.zero_touch())
    async with procedures.lifted_after():
        match config.method:
            case "camera":
                points = await FirstInkTouch(procedures, config, dip).measure(points_mm)
            case "force":
                points = await _at_points(procedures, config, points_mm, _by_force(procedures, config, tap, tell))
            case "jog":
                points = await _at_points(procedures, config, points_mm, _by_jog(procedures, config, asker))
    return through(points, config)


Point = tuple[float, float]
TouchOnce = Callable[[str, Point, Reach, Sequence[Touch]], Awaitable[Touch]]
"""Touches once: its name for the person, its place, the approach, and the touches there before it."""


async def _at_points(
    procedures: Procedures, config: TouchConfig, points_mm: list[Point], touch: TouchOnce
) -> list[TouchedPoint]:
    known, points, count = KnownHeights(procedures.rig.config.paper, config), list[TouchedPoint](), 0
    for point in points_mm:
        reach, touches = known.reach(*point), list[Touch]()
        await procedures.approach(*point, reach.start_z_mm)
        for _ in range(config.touches):
            count += 1
            touches.append(await touch(f"touch {count} of {len(points_mm) * config.touches}", point, reach, touches))
        await procedures.lift()
        mean = at_one_point(touches, config)
        points.append(mean)
        known.add(mean.x_mm, mean.y_mm, mean.z_mm)
    return points


def _by_force(procedures: Procedures, config: TouchConfig, tap: ForceTap, tell: Callable[[str], None]) -> TouchOnce:
    if procedures.rig.force is None:
        raise StepError("zero touch by force needs a force sensor: [force] is missing")

    rest: Rest | None = None
    spring: Spring | None = None

    async def once(name: str, point: Point, reach: Reach, before: Sequence[Touch]) -> Touch:
        nonlocal rest, spring
        tell(f"{name}: down to the paper until the force is known to {config.force.sigma_mm:g} mm")
        near_z_mm = before[-1].z_mm if before else None
        if rest is None or not before:
            rest = resting(procedures, tap, point, config)
        contact = await touch_by_force(rest, reach, config.force, spring, near_z_mm)
        spring = contact.spring
        return Touch(*point, contact.z_mm, contact.sigma_mm)

    return once


JOG_MM = {"1": -1.0, "2": -0.1, "3": -0.02, "8": 0.02, "9": 0.1, "0": 1.0}
"""Step of each key, positive up."""
TOUCHES, GIVE_UP = "t", "x"
ROUNDING_MM = 1e-6


def _by_jog(procedures: Procedures, config: TouchConfig, asker: Asker) -> TouchOnce:
    choices = (
        *(Choice(key, f"{'down' if step < 0 else 'up'} {abs(step):g} mm") for key, step in JOG_MM.items()),
        Choice(TOUCHES, "the tip just touches"),
        Choice(GIVE_UP, "give up: the height of the paper stays unchanged"),
    )

    async def once(name: str, point: Point, reach: Reach, _before: Sequence[Touch]) -> Touch:
        """Leaves the brush where the operator stopped. A step beyond either end of the approach is shortened."""
        z_mm = reach.start_z_mm
        while True:
            rests_mm = await procedures.lower(*point, z_mm, config.speed_mm_s)
            question = (
                f"{name.capitalize()}. Jog until the tip just touches the paper. "
                f"It is {rests_mm - reach.expected_z_mm:+.2f} mm from the expected height."
            )
            if z_mm <= reach.lowest_z_mm + ROUNDING_MM:
                question += (
                    " This is the end of the travel: if nothing touches, give up, and correct touch_z_mm in rig.toml."
                )
            key = await asker.ask(Prompt(question, choices, GIVE_UP))
            if key == GIVE_UP:
                raise NeedsOperator(f"the operator gave up at {name}")
            if key == TOUCHES:
                return Touch(*point, rests_mm)
            z_mm = min(max(z_mm + JOG_MM[key], reach.lowest_z_mm), reach.start_z_mm)

    return once
