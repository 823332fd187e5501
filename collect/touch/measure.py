"""Zero touch as one step: the plane from which H is counted, by the method of the configuration."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from collect.errors import StepError
from collect.rig.config_touch import TouchConfig
from collect.rig.devices import Rig
from collect.rig.paper import PaperPlane
from collect.touch.arm import ForceTap, RigProbe, TouchArm, TouchEffector
from collect.touch.camera import FirstInkTouch
from collect.touch.force import touch_by_force
from collect.touch.heights import KnownHeights, PlaneResult, PointTouches, Reach, Touch, at_one_point, through
from collect.touch.jog import NextJog, touch_by_jog


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

    `tap` is handed every sample of the force sensor, which must have been set to zero with nothing touching. `next_jog`
    asks the operator, `tell` reports progress. Raises `StepError`, with the figures, where nothing is touched, touches
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

    async def touch(number: int, point: Point, reach: Reach) -> list[Touch]:
        probe = RigProbe(arm, tap, rig.clock, point, config.force)
        near_z_mm, touches = None, list[Touch]()
        for k in range(config.touches):
            tell(f"point {number + 1} of {max(len(config.points_mm), 1)}, touch {k + 1} of {config.touches}")
            contact = await touch_by_force(probe, reach, config.force, near_z_mm)
            near_z_mm = contact.z_mm
            touches.append(Touch(*point, contact.z_mm, contact.sigma_mm))
        return touches

    return touch


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
