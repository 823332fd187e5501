"""The person in the lab: guides the arm by hand to things, holds the board, pushes the sensor, mends what is wrong.

| request, with `"do": "hand"` | what the person does |
|---|---|
| `{"act": "bring", "to": "pin", "index": 2}` | guides the tip to a thing, of `THINGS`, and lets go |
| `{"act": "bring", "to": "board-corner", "corner": "lower left"}` | the same, for a corner of the board or sheet |
| `{"act": "bring", "to": "hold-board", "index": 0}` | holds the print before the camera until the next act |
| `{"act": "bring", "to": "push-sensor", "index": 0}` | pushes the tip: 0 toward the flange, 1 and 2 aside |
| `{"act": "measure", "to": "square"}` | measures with calipers or a ruler: `square`, `marker`, `tool` |
| `{"act": "mend"}` | corrects what is wrong, once the person was asked to: the trap's mistake ends |
| `{"act": "plug"}` | puts a cable back |

Every answer has `says`, what the person would say; `bring` has `reached` too.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Any, Protocol

from scipy.spatial.transform import Rotation

from drivers.arcs.codes import MOVING_ALLOWED, RobotMode
from drivers.geometry import interpolate
from drivers.samples import Pose
from drivers.sim.arcs.cabinet import Cabinet
from drivers.sim.arm.kinematics import Joints, inverted
from drivers.sim.camera.held import Held
from drivers.sim.lab.aims import TOUCHED, Aims
from drivers.sim.lab.facts import LIFT_MM, Facts, joints_for
from drivers.sim.lab.places import shifted, withdrawn
from drivers.sim.world import World

THINGS = (
    *("pin", "upright", "board-corner", "sheet-corner", "well", "well-rim", "wash-pot", "wash-rim"),
    *("park", "clear-view", "hold-board", "push-sensor"),
)
SPEED_RAD_S, ACC_RAD_S2 = 0.35, 1.0
LOOK_S = 0.005
PUSH_N, PUSH_S = 2.0, 1.0
PUSHES = ((0.0, 0.0, -PUSH_N), (PUSH_N, 0.0, 0.0), (0.0, PUSH_N, 0.0))
"""Forces in the brush's frame, N: along the brush toward the flange, then along its x and y."""
HALVINGS = 5
"""Bisection steps on the way to a thing out of reach, which find how near the arm can come."""


class Lab(Protocol):
    """The things in a lab that a person can handle."""

    @property
    def facts(self) -> Facts:
        """The current state of the lab."""
        ...

    @property
    def world(self) -> World:
        """The arm and what it touches."""
        ...

    @property
    def cabinet(self) -> Cabinet:
        """The controller, with its pendant."""
        ...

    def hold(self, board: Held | None) -> None:
        """Hold the print before the camera, or put it away."""
        ...

    async def mend(self) -> str:
        """Correct the mistake that the trap is; return what was done."""
        ...

    def plug(self) -> str:
        """Put the cable back; return what was done."""
        ...

    def touched(self) -> None:
        """Another thing was touched: time for an accident."""
        ...


class Hand:
    """The person's hands, which do one thing at a time."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._aims = Aims(lambda: lab.facts)
        self._busy = asyncio.Lock()

    async def obey(self, request: Mapping[str, object]) -> dict[str, Any]:
        """Carry out a request as in the table above. Raises ValueError, with a one-line message, for an invalid one."""
        act, to = request.get("act"), str(request.get("to", ""))
        index, corner = request.get("index", 0), str(request.get("corner", ""))
        if type(index) is not int or not 0 <= index < 1000:
            raise ValueError(f"index = {index!r}: must be a whole number from 0 to 999")
        async with self._busy:
            match act:
                case "bring":
                    return await self.bring(to, index, corner)
                case "measure":
                    return {"says": self.measure(to)}
                case "mend":
                    return {"says": await self._lab.mend()}
                case "plug":
                    return {"says": self._lab.plug()}
                case _:
                    raise ValueError(f"act = {act!r} is not one of bring, measure, mend, plug")

    async def bring(self, to: str, index: int = 0, corner: str = "") -> dict[str, Any]:
        """Carry out `bring`, as in the table above. Raises ValueError for a thing that the lab does not have."""
        if to not in THINGS:
            raise ValueError(f"to = {to!r} is not one of {', '.join(THINGS)}")
        self._lab.hold(self._aims.board(index) if to == "hold-board" else None)
        if to == "hold-board":
            return {"reached": True, "says": "I hold the print before the camera."}
        if to == "push-sensor":
            return await self._push(index)
        aim = self._aims.tip(to, index, corner)
        if (trouble := await self._take_hold()) is not None:
            return {"reached": False, "says": trouble}
        short_mm = await self._guide(aim, back_mm=LIFT_MM if to == "pin" else 0.0)
        if to in TOUCHED:
            self._lab.touched()
        if short_mm > 0.0:
            return {"reached": False, "says": f"The arm is stretched out, {short_mm:.0f} mm before the {to}."}
        return {"reached": True, "says": f"The tip is at the {to}{f', {corner}' if corner else ''}."}

    def measure(self, what: str) -> str:
        """A length as the person writes it down. Raises ValueError for one that nobody can measure."""
        facts = self._lab.facts
        lengths_mm = {
            "square": round(facts.config.table.board_square_mm, 2),
            "marker": round(facts.config.table.board_marker_mm, 2),
            "tool": round(facts.config.tool_mm),
        }
        if what not in lengths_mm:
            raise ValueError(f"to = {what!r} is not one of {', '.join(lengths_mm)}")
        return f"{lengths_mm[what] / 1e3:g}" if facts.ruler_unit == "m" and what == "tool" else f"{lengths_mm[what]:g}"

    async def _push(self, index: int) -> dict[str, Any]:
        brush = Rotation.from_quat(self._lab.world.tool().quaternion)
        x, y, z = (float(v) for v in brush.apply(PUSHES[index % len(PUSHES)]))
        self._lab.world.push_n = (x, y, z)
        try:
            await asyncio.sleep(PUSH_S)
        finally:
            self._lab.world.push_n = (0.0, 0.0, 0.0)
        return {"reached": True, "says": "I pushed the tip for a second."}

    async def _take_hold(self) -> str | None:
        """Power the arm at the pendant; return why it cannot be guided."""
        world, power = self._lab.world, self._lab.cabinet.power
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

    async def _guide(self, aim: Pose, back_mm: float) -> float:
        """Lift, swing over, lower; return by how many mm the aim was missed because it is out of reach."""
        world = self._lab.world
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
        free = inverted(self._lab.world.motion.tool)
        best, reached, part = None, start, 0.0
        for halving in range(1, HALVINGS + 1):
            pose = interpolate(start, end, part + 0.5**halving)
            if (found := joints_for(free, pose, near)) is not None:
                best, reached, part = found, pose, part + 0.5**halving
        return best, reached

    async def _move(self, way: list[Joints]) -> None:
        world, motion = self._lab.world, self._lab.world.motion
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
