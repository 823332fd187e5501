"""Zero touch as one step: the plane from which H is counted, by the method of the configuration; and touches by jog."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from brushloop.collect.errors import JogGivenUp, StepError
from brushloop.collect.motion import Dip, Procedures
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.rig.config import TouchConfig
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.touch.camera import FirstInkTouch
from brushloop.collect.touch.force import ForceTap, RigProbe, Spring, touch_by_force
from brushloop.collect.touch.heights import KnownHeights, Reach, Touch, at_one_point, through, untouched
from brushloop.sessions.events import TouchedPoint, ZeroTouchResult


async def measure_plane(
    procedures: Procedures,
    config: TouchConfig,
    *,
    dip: Dip | None = None,
    tap: ForceTap | None = None,
    next_jog: NextJog | None = None,
    tell: Callable[[str], None] = lambda _words: None,
) -> ZeroTouchResult:
    """Touch as configured and fit the plane. The arm begins and ends at travel height.

    `dip` fills the brush. `tap` receives every sample of the force sensor, which must have been set to zero with
    nothing touching. `next_jog` asks the operator, `tell` reports progress. Raises `StepError`, with the figures, if
    nothing is touched, touches do not repeat, or the points do not lie in a plane; the brush is lifted then, too.
    """
    paper = procedures.rig.config.paper
    points_mm = config.points_mm or [paper.touch_point_mm]
    if config.method == "taught":
        touch = Touch(*paper.touch_point_mm, await procedures.zero_touch())
        return untouched(PaperPlane(paper.touch_z_mm), "taught", touch)
    async with procedures.lifted_after():
        match config.method:
            case "camera":
                points = await FirstInkTouch(procedures, config, dip or procedures.dip).measure(points_mm)
            case "force":
                points = await _at_points(procedures, config, points_mm, _by_force(procedures, config, tap, tell))
            case "jog":
                points = await _at_points(procedures, config, points_mm, _by_jog(procedures, config, next_jog))
    return through(points, config)


Point = tuple[float, float]
TouchPoint = Callable[[int, Point, Reach], Awaitable[list[Touch]]]
"""Touches one point several times: its number from 0, its place, and the approach."""


async def _at_points(
    procedures: Procedures, config: TouchConfig, points_mm: list[Point], touch: TouchPoint
) -> list[TouchedPoint]:
    known, points = KnownHeights(procedures.rig.config.paper, config), list[TouchedPoint]()
    for number, point in enumerate(points_mm):
        reach = known.reach(*point)
        await procedures.approach(*point, reach.start_z_mm)
        touches = await touch(number, point, reach)
        await procedures.lift()
        mean = at_one_point(touches, config)
        points.append(mean)
        known.add(mean.x_mm, mean.y_mm, mean.z_mm)
    return points


def _by_force(
    procedures: Procedures, config: TouchConfig, tap: ForceTap | None, tell: Callable[[str], None]
) -> TouchPoint:
    if procedures.rig.force is None or tap is None:
        raise StepError("zero touch by force needs a force sensor: [force] is missing")

    spring: Spring | None = None

    async def touch(number: int, point: Point, reach: Reach) -> list[Touch]:
        nonlocal spring
        probe = RigProbe(procedures, tap, point, config)
        near_z_mm, touches = None, list[Touch]()
        for k in range(config.touches):
            place = f"point {number + 1} of {max(len(config.points_mm), 1)}, touch {k + 1} of {config.touches}: "
            contact = await touch_by_force(
                probe, reach, config.force, spring, near_z_mm, lambda doing, place=place: tell(place + doing)
            )
            near_z_mm, spring = contact.z_mm, contact.spring
            touches.append(Touch(*point, contact.z_mm, contact.sigma_mm))
        return touches

    return touch


def _by_jog(procedures: Procedures, config: TouchConfig, next_jog: NextJog | None) -> TouchPoint:
    if next_jog is None:
        raise StepError("zero touch by jog needs an operator at a screen")

    async def touch(number: int, point: Point, reach: Reach) -> list[Touch]:
        first, of = number * config.touches + 1, max(len(config.points_mm), 1) * config.touches
        return [
            await _touch_by_jog(procedures, point, reach, config, next_jog, first + k, of)
            for k in range(config.touches)
        ]

    return touch


@dataclass(frozen=True, slots=True)
class Jogged:
    """Position of the tip, as the operator sees it."""

    above_mm: float
    """Height above the expected one."""
    lowest: bool
    """Whether it is at the end of the travel: nothing lower is allowed."""
    number: int
    """Number of the touch, from 1."""
    of: int
    """Total number of touches, over all points."""


NextJog = Callable[[Jogged], Awaitable[float | None]]
"""The next step in mm, positive up; None if the tip touches."""
ROUNDING_MM = 1e-6
JOG_MM = {"1": -1.0, "2": -0.1, "3": -0.02, "8": 0.02, "9": 0.1, "0": 1.0}
"""Step of each key, positive up."""


async def _touch_by_jog(
    procedures: Procedures, at_mm: Point, reach: Reach, config: TouchConfig, next_jog: NextJog, number: int, of: int
) -> Touch:
    """Touch `number` of `of`; the brush is left where the operator stopped.

    A step that would go below the end of the travel, or above where the jog began, is shortened.
    """
    z_mm = reach.start_z_mm
    while True:
        rests_mm = await procedures.lower(*at_mm, z_mm, config.speed_mm_s)
        lowest = z_mm <= reach.lowest_z_mm + ROUNDING_MM
        step_mm = await next_jog(Jogged(rests_mm - reach.expected_z_mm, lowest, number, of))
        if step_mm is None:
            return Touch(*at_mm, rests_mm)
        z_mm = min(max(z_mm + step_mm, reach.lowest_z_mm), reach.start_z_mm)


def asked(asker: Asker, height: str = "the height") -> NextJog:
    """Ask for each jog on the screen. `height` names the height that is kept without a jog.

    The returned function raises `NeedsOperator` if nobody watches, and `JogGivenUp` if the operator gives up.
    """
    choices = (
        *(Choice(key, f"{'down' if step < 0 else 'up'} {abs(step):g} mm") for key, step in JOG_MM.items()),
        Choice("t", "the tip just touches"),
        Choice("x", f"give up: {height} stays unchanged"),
    )

    async def next_jog(at: Jogged) -> float | None:
        question = (
            f"Touch {at.number} of {at.of}. Jog until the tip just touches the paper. "
            f"It is {at.above_mm:+.2f} mm from the expected height."
        )
        if at.lowest:
            question += (
                " This is the end of the travel: if nothing touches, give up, and correct touch_z_mm in rig.toml."
            )
        key = await asker.ask(Prompt(question, choices, "x"))
        if key == "x":
            raise JogGivenUp(at.number, at.of, height)
        return JOG_MM.get(key)

    return next_jog
