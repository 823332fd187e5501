"""The hands of the person in the lab: they guide the arm to a place, and push the sensor."""

from __future__ import annotations

import asyncio
import math

from scipy.spatial.transform import Rotation

from brushloop.drivers.arcs.codes import MOVING_ALLOWED, RobotMode
from brushloop.drivers.geometry import interpolate
from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.arcs.cabinet import Cabinet
from brushloop.drivers.sim.arm.kinematics import Joints, inverted
from brushloop.drivers.sim.lab.facts import LIFT_MM, joints_for
from brushloop.drivers.sim.lab.places import shifted, withdrawn

SPEED_RAD_S, ACC_RAD_S2 = 0.35, 1.0
LOOK_S = 0.005
PUSH_N, PUSH_S = 2.0, 1.0
PUSHES = ((0.0, 0.0, -PUSH_N), (PUSH_N, 0.0, 0.0), (0.0, PUSH_N, 0.0))
"""Forces in the brush's frame, N: along the brush toward the flange, then along its x and y."""
HALVINGS = 5
"""Bisection steps on the way to a thing out of reach, which find how near the arm can come."""


class Hand:
    """Hands on the arm of one controller."""

    def __init__(self, cabinet: Cabinet) -> None:
        self._cabinet = cabinet
        self._world = cabinet.world

    async def push(self, index: int) -> None:
        """Push the tip for `PUSH_S`, in the direction of this index of `PUSHES`."""
        brush = Rotation.from_quat(self._world.tool().quaternion)
        x, y, z = (float(v) for v in brush.apply(PUSHES[index % len(PUSHES)]))
        self._world.push_n = (x, y, z)
        try:
            await asyncio.sleep(PUSH_S)
        finally:
            self._world.push_n = (0.0, 0.0, 0.0)

    async def take_hold(self) -> str | None:
        """Power the arm at the pendant; return why it cannot be guided."""
        world, power = self._world, self._cabinet.power
        if power.safety not in MOVING_ALLOWED:
            return f"The pendant shows {power.safety.value}: that has to be ended first."
        world.tool()
        if world.motion.running is not None or world.motion.held:
            return "The arm moves by itself; I keep my hands off."
        while power.mode != RobotMode.RUNNING:
            power.power_on()
            power.start_up()
            await asyncio.sleep(LOOK_S)
        return None

    async def guide(self, aim: Pose, back_mm: float) -> float:
        """Lift, swing over, lower; return by how many mm the aim was missed because it is out of reach."""
        world = self._world
        here = world.tool()
        free = inverted(world.motion.tool)
        near = world.motion.joints(world.clock.now_s())
        above = withdrawn(aim, back_mm) if back_mm else shifted(aim, (0.0, 0.0, LIFT_MM))
        lifted = withdrawn(here, LIFT_MM)
        reached, way = here, list[Joints]()
        for pose in (lifted, above, aim):
            found = joints_for(free, pose, near)
            if found is None and pose is not lifted:
                found, pose = self._nearest(reached, pose, near)
            if found is None:
                continue  # a stretched arm is not lifted along its brush: it swings over at once
            way.append(found)
            near, reached = found, pose
        await self._move(way)
        return math.dist(reached.position_mm, aim.position_mm)

    def _nearest(self, start: Pose, end: Pose, near: Joints) -> tuple[Joints | None, Pose]:
        """The joints for the last pose within reach on the straight way to `end`, and that pose, by halving."""
        free = inverted(self._world.motion.tool)
        best, reached, part = None, start, 0.0
        for halving in range(1, HALVINGS + 1):
            pose = interpolate(start, end, part + 0.5**halving)
            if (found := joints_for(free, pose, near)) is not None:
                best, reached, part = found, pose, part + 0.5**halving
        return best, reached

    async def _move(self, way: list[Joints]) -> None:
        world, motion = self._world, self._world.motion
        world.hand_guided = True
        try:
            for joints in way:
                motion.add_joints(joints, SPEED_RAD_S, ACC_RAD_S2, world.clock.now_s(), 0.0)
            world.tool()
            while motion.running is not None:
                await asyncio.sleep(LOOK_S)
                world.tool()
        finally:
            world.hand_guided = False
