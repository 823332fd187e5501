"""Zero touch as one step: the plane from which H is counted, by the method of the configuration; and touches by jog."""

from __future__ import annotations

import functools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from brushloop.collect.errors import JogGivenUp, StepError
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.rig.config_touch import JogTouchConfig, TouchConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.touch.arm import ForceTap, RigProbe, TouchArm, TouchEffector
from brushloop.collect.touch.camera import FirstInkTouch
from brushloop.collect.touch.force import Spring, touch_by_force
from brushloop.collect.touch.heights import KnownHeights, PlaneResult, PointTouches, Reach, Touch, at_one_point, through


async def measure_plane(
    rig: Rig,
    effector: TouchEffector,
    config: TouchConfig,
    *,
    tap: ForceTap | None = None,
    next_jog: NextJog | None = None,
    tell: Callable[[str], None] = lambda _words: None,
) -> PlaneResult:
    """Touch as configured and fit the plane. The arm begins and ends at travel height.

    `tap` receives every sample of the force sensor, which must have been set to zero with nothing touching. `next_jog`
    asks the operator, `tell` reports progress. Raises `StepError`, with the figures, if nothing is touched, touches
    do not repeat, or the points do not lie in a plane; the brush is lifted in that case too.
    """
    if config.method == "taught":
        return await _taught(rig, effector)
    arm = TouchArm(rig, config.speed_mm_s)
    points_mm = config.points_mm or [rig.config.paper.touch_point_mm]
    async with arm.lifted_after():
        match config.method:
            case "camera":
                found = await FirstInkTouch(rig, effector, arm, config).measure(points_mm)
            case "force":
                found = await _at_points(rig, arm, config, points_mm, _by_force(rig, arm, config, tap, tell))
            case "jog":
                found = await _at_points(rig, arm, config, points_mm, _by_jog(arm, config, len(points_mm), next_jog))
    return through(found, config)


async def _taught(rig: Rig, effector: TouchEffector) -> PlaneResult:
    touch = Touch(*rig.config.paper.touch_point_mm, await effector.zero_touch())
    return PlaneResult(PaperPlane(rig.config.paper.touch_z_mm), "taught", (PointTouches((touch,), 0.0),), (0.0,))


Point = tuple[float, float]
TouchPoint = Callable[[int, Point, Reach], Awaitable[list[Touch]]]
"""Touches one point several times: its number from 0, its place, and the approach."""


async def _at_points(
    rig: Rig, arm: TouchArm, config: TouchConfig, points_mm: list[Point], touch: TouchPoint
) -> list[PointTouches]:
    known, found = KnownHeights(rig.config.paper, config), list[PointTouches]()
    for number, point in enumerate(points_mm):
        reach = known.reach(*point)
        await arm.over(*point)
        await arm.near(*point, reach.start_z_mm)
        touches = await touch(number, point, reach)
        await arm.lift()
        found.append(at_one_point(touches, config))
        known.add(*found[-1].mean)
    return found


def _by_force(
    rig: Rig, arm: TouchArm, config: TouchConfig, tap: ForceTap | None, tell: Callable[[str], None]
) -> TouchPoint:
    if rig.force is None or tap is None:
        raise StepError("zero touch by force needs a force sensor: [force] is missing")

    spring: Spring | None = None

    async def touch(number: int, point: Point, reach: Reach) -> list[Touch]:
        nonlocal spring
        probe = RigProbe(arm, tap, rig.clock, point, config.force)
        near_z_mm, touches = None, list[Touch]()
        for k in range(config.touches):
            place = f"point {number + 1} of {max(len(config.points_mm), 1)}, touch {k + 1} of {config.touches}"
            report = functools.partial(_report, tell, place)
            contact = await touch_by_force(probe, reach, config.force, spring, near_z_mm, report)
            near_z_mm, spring = contact.z_mm, contact.spring
            touches.append(Touch(*point, contact.z_mm, contact.sigma_mm))
        return touches

    return touch


def _report(tell: Callable[[str], None], place: str, doing: str) -> None:
    tell(f"{place}: {doing}")


def _by_jog(arm: TouchArm, config: TouchConfig, points: int, next_jog: NextJog | None) -> TouchPoint:
    if next_jog is None:
        raise StepError("zero touch by jog needs an operator at a screen")

    async def touch(number: int, point: Point, reach: Reach) -> list[Touch]:
        first = number * config.touches + 1
        return [
            await touch_by_jog(arm, point, reach, config.jog, next_jog, first + k, points * config.touches)
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


async def touch_by_jog(
    arm: TouchArm,
    at_mm: tuple[float, float],
    reach: Reach,
    config: JogTouchConfig,
    next_jog: NextJog,
    number: int = 1,
    of: int = 1,
) -> Touch:
    """Touch `number` of `of`; the brush is left where the operator stopped.

    A step that would go below the end of the travel, or above where the jog began, is shortened. Raises `StepError` for
    a step of a size that the configuration does not have.
    """
    z_mm = reach.start_z_mm
    while True:
        rests_mm = await arm.to(*at_mm, z_mm)
        lowest = z_mm <= reach.lowest_z_mm + ROUNDING_MM
        step_mm = await next_jog(Jogged(rests_mm - reach.expected_z_mm, lowest, number, of))
        if step_mm is None:
            return Touch(*at_mm, rests_mm)
        if all(abs(abs(step_mm) - size) > ROUNDING_MM for size in config.steps_mm):
            raise StepError(f"a jog of {step_mm:g} mm is not one of {', '.join(f'{s:g}' for s in config.steps_mm)} mm")
        z_mm = min(max(z_mm + step_mm, reach.lowest_z_mm), reach.start_z_mm)


def asked(asker: Asker, config: JogTouchConfig, height: str = "the height") -> NextJog:
    """Ask for each jog on the screen. `height` names the height that is kept without a jog.

    The returned function raises `NeedsOperator` if nobody watches, and `JogGivenUp` if the operator gives up.
    """
    small, middle, large = config.steps_mm
    keys = {"1": -large, "2": -middle, "3": -small, "8": small, "9": middle, "0": large}
    choices = (
        *(Choice(key, f"{'down' if step < 0 else 'up'} {abs(step):g} mm") for key, step in keys.items()),
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
        return keys.get(key)

    return next_jog
