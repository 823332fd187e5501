"""Zero touch as one step: the plane from which H is counted, by the method of the configuration."""

from __future__ import annotations

from collections.abc import Callable

from collect.errors import StepError
from collect.rig.config_touch import TouchConfig
from collect.rig.devices import Rig
from collect.rig.paper import PaperPlane
from collect.touch.arm import ForceTap, RigProbe, TouchArm, TouchEffector
from collect.touch.camera import FirstInkTouch
from collect.touch.force import touch_by_force
from collect.touch.heights import KnownHeights, PlaneResult, PointTouches, Touch, at_one_point, through
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

    `tap` must be handed every sample of the force sensor; without one, the sensor is listened to here. `next_jog` asks
    the operator, `tell` reports progress. The force must have been set to zero with nothing touching. Raises
    `StepError`, with the figures, where nothing is touched, touches do not repeat, or the points do not lie in a plane;
    the brush is lifted in that case too.
    """
    if config.method == "taught":
        return await _taught(rig, effector)
    arm = TouchArm(rig, config.speed_mm_s)
    points_mm = config.points_mm or [rig.config.paper.touch_point_mm]
    async with arm.lifted_after():
        match config.method:
            case "camera":
                return through(await FirstInkTouch(rig, effector, arm, config).measure(points_mm), config)
            case "force":
                return through(await _by_force(rig, arm, config, points_mm, tap, tell), config)
            case "jog":
                if next_jog is None:
                    raise StepError("zero touch by jog needs an operator at a screen")
                return through(await _by_jog(rig, arm, config, points_mm, next_jog), config)


async def _taught(rig: Rig, effector: TouchEffector) -> PlaneResult:
    touch = Touch(*rig.config.paper.touch_point_mm, await effector.zero_touch())
    return PlaneResult(PaperPlane(rig.config.paper.touch_z_mm), "taught", (PointTouches((touch,), 0.0),), (0.0,))


async def _by_force(
    rig: Rig,
    arm: TouchArm,
    config: TouchConfig,
    points_mm: list[tuple[float, float]],
    tap: ForceTap | None,
    tell: Callable[[str], None],
) -> list[PointTouches]:
    if rig.force is None:
        raise StepError("zero touch by force needs a force sensor: [force] is missing")
    heard = tap or ForceTap()
    if tap is None:
        rig.force.listen(heard.take)
    try:
        known, found = KnownHeights(rig.config.paper, config), list[PointTouches]()
        for point in points_mm:
            reach, near_z_mm, touches = known.reach(*point), None, list[Touch]()
            await arm.over(*point)
            await arm.near(*point, reach.start_z_mm)
            probe = RigProbe(arm, heard, rig.clock, point, config.force)
            for number in range(config.touches):
                tell(f"point {len(found) + 1} of {len(points_mm)}, touch {number + 1} of {config.touches}")
                contact = await touch_by_force(probe, reach, config.force, near_z_mm)
                near_z_mm = contact.z_mm
                touches.append(Touch(*point, contact.z_mm, contact.sigma_mm))
            await arm.lift()
            found.append(at_one_point(touches, config))
            known.add(*found[-1].mean)
        return found
    finally:
        if tap is None:
            rig.force.listen(None)


async def _by_jog(
    rig: Rig, arm: TouchArm, config: TouchConfig, points_mm: list[tuple[float, float]], next_jog: NextJog
) -> list[PointTouches]:
    known, found = KnownHeights(rig.config.paper, config), list[PointTouches]()
    for point in points_mm:
        reach = known.reach(*point)
        await arm.over(*point)
        await arm.near(*point, reach.start_z_mm)
        touches = list[Touch]()
        for _ in range(config.touches):
            number = len(found) * config.touches + len(touches) + 1
            of = len(points_mm) * config.touches
            touches.append(await touch_by_jog(arm, point, reach, config.jog, next_jog, number, of))
        await arm.lift()
        found.append(at_one_point(touches, config))
        known.add(*found[-1].mean)
    return found
