"""The person in the lab: the places a hand aims at, with its errors, and the hands that guide the arm there."""

from __future__ import annotations

import asyncio
import math
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.drivers.arcs.controller import MOVING_ALLOWED, RobotMode
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import interpolate
from brushloop.drivers.sim.arcs.cabinet import Cabinet
from brushloop.drivers.sim.kinematics import Joints, inverted
from brushloop.drivers.sim.lab.facts import (
    LIFT_MM,
    PIN_TILT_DEG,
    Facts,
    Place,
    azimuth_deg,
    board_size_mm,
    corner,
    held,
    in_base,
    joints_for,
    over_sheet,
    shifted,
    withdrawn,
)
from brushloop.drivers.sim.scene import Floats, Held

TOUCHED = ("pin", "board-corner", "sheet-corner", "well-rim", "wash-rim")
"""Things that the tip touches; it is brought to the others by eye."""
BY_EYE_MM = 1.0
"""Standard deviation of a tip that is brought near a thing by eye, along each axis."""
SEEN_SIGMAS = 2.5
"""Errors beyond this many standard deviations are seen and corrected by the person."""
UPRIGHT_DEG = 1.0
"""Standard deviation of a brush that is held upright by eye, about either axis."""
SQUARE_DEG = 0.15
"""The same for a brush that is held upright against a set square."""
DIP_ABOVE_BOTTOM_MM = 2.5
UPRIGHT_ABOVE_MM = 70.0


@dataclass(frozen=True, slots=True)
class Grip:
    """How the board is held: its slant and the side toward which it slants, its turn in the picture, its place."""

    slant_deg: float = 0.0
    toward_deg: float = 0.0
    turn_deg: float = 0.0
    aside: tuple[float, float] = (0.0, 0.0)
    """Right and down, in shares of the picture's width and height."""


HELD = (
    Grip(3.0),
    *(Grip(28.0, toward) for toward in (270.0, 90.0, 0.0, 180.0)),
    Grip(22.0, 45.0, 0.0, (-0.17, -0.17)),
    Grip(22.0, 135.0, 0.0, (0.17, -0.17)),
    Grip(22.0, 225.0, 0.0, (0.17, 0.17)),
    Grip(22.0, 315.0, 0.0, (-0.17, 0.17)),
    Grip(25.0, 60.0, 90.0),
)
"""How a person is asked to hold it: flat, slanted to each side, in the four corners, and turned by a quarter."""


def _any_grip(rng: np.random.Generator) -> Grip:
    x, y, toward = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(0, 360)
    return Grip(float(rng.uniform(18, 30)), float(toward), 0.0, (float(x), float(y)))


class Aims:
    """The person's aims in one lab. An error depends on the seed, the thing, and how often it was asked for."""

    def __init__(self, facts: Callable[[], Facts]) -> None:
        self._facts = facts
        self._asked: Counter[str] = Counter()

    def tip(self, to: str, index: int, name: str) -> Pose:
        """Pose of the tip for a thing. Raises ValueError for one that the lab does not have."""
        facts, rng = self._facts(), self._drawn(to, index, name)
        place = self._place(facts, to, name)
        wrist_deg = azimuth_deg(place) + float(rng.normal(0.0, 5.0))
        tilt_deg, toward_deg = 0.0, 0.0
        if to == "pin":
            tilt_deg, toward_deg, wrist_deg = self._pin(index, wrist_deg, rng)
        elif to == "upright":
            wrist_deg += (0.0, 100.0, -100.0, 50.0, -50.0)[index % 5]
        spread_mm = facts.hand_mm if to in TOUCHED else BY_EYE_MM
        x, y, z = (float(v) for v in np.array(place) + _error_mm(rng, spread_mm))
        aimed = held((x, y, z), wrist_deg=wrist_deg, tilt_deg=tilt_deg, toward_deg=toward_deg)
        return _unsteady(aimed, SQUARE_DEG if to == "upright" else UPRIGHT_DEG, rng)

    def board(self, index: int) -> Held:
        """How the board is held before the camera: each time at another slant and in another part of the picture."""
        facts, rng = self._facts(), self._drawn("hold-board", index, "")
        view, table = facts.config.view, facts.config.table
        pose = HELD[index] if index < len(HELD) else _any_grip(rng)
        size_x_mm, size_y_mm = board_size_mm(table)
        high = view.height_px / view.width_px
        longest = max(size_x_mm, size_y_mm / high) if abs(pose.turn_deg) < 45.0 else max(size_y_mm, size_x_mm / high)
        across_mm = longest / float(rng.uniform(0.85, 0.95))
        toward = math.radians(pose.toward_deg + float(rng.uniform(-15, 15)))
        slant_deg = pose.slant_deg + float(rng.uniform(-3, 3))
        in_picture = Rotation.from_euler("z", pose.turn_deg + float(rng.normal(0.0, 4.0)), degrees=True)
        axis = slant_deg * np.array([math.cos(toward), math.sin(toward), 0.0])
        turn = Rotation.from_rotvec(axis, degrees=True) * in_picture
        rx, ry, rz = (float(v) for v in turn.as_rotvec(degrees=True))
        x, y = pose.aside
        return Held((rx, ry, rz), (x * across_mm, y * across_mm * high, view.focal * across_mm))

    def _pin(self, index: int, wrist_deg: float, rng: np.random.Generator) -> tuple[float, float, float]:
        """(tilt, its direction, wrist) in deg. The brush leans to each of four sides in turn; in every second round the
        sides lie between those of the first, and from round to round the wrist turns."""
        tilt_deg = PIN_TILT_DEG + float(rng.uniform(-4, 0))
        toward_deg = 90.0 * index + 45.0 * (index // 4 % 2) + float(rng.uniform(-8, 8))
        return tilt_deg, toward_deg, wrist_deg + (0.0, 70.0, -70.0)[index // 4 % 3]

    def _place(self, facts: Facts, to: str, name: str) -> Place:
        table = facts.config.table
        match to:
            case "pin":
                return facts.pin_mm
            case "board-corner" | "sheet-corner":
                return corner(table, to.removesuffix("-corner"), self._meant(facts, name))
            case "well":
                return in_base(table, *table.well_mm, DIP_ABOVE_BOTTOM_MM)
            case "well-rim" | "wash-rim":
                x, y = table.well_mm if to == "well-rim" else facts.wash_mm
                return in_base(table, x, y + table.well_radius_mm, table.well_depth_mm)
            case "wash-pot":
                return in_base(table, *facts.wash_mm, DIP_ABOVE_BOTTOM_MM)
            case "park" if facts.parks_in_picture:
                return over_sheet(table, facts.park_mm[2] - table.paper_z_mm)
            case "park":
                return facts.park_mm
            case "clear-view":
                return facts.clear_mm
            case "upright":
                return over_sheet(table, UPRIGHT_ABOVE_MM)
            case _:
                raise ValueError(f"to = {to!r}: there is no such thing in this lab")

    def _meant(self, facts: Facts, name: str) -> str:
        """The corner that the person takes for the one that was asked for."""
        words = " ".join(name.replace("-", " ").replace("_", " ").split())
        if facts.swapped is not None and words in facts.swapped:
            return facts.swapped[1 - facts.swapped.index(words)]
        return words

    def _drawn(self, to: str, index: int, name: str) -> np.random.Generator:
        key = f"{to} {index} {name}"
        self._asked[key] += 1
        return np.random.default_rng([self._facts().seed, 31, zlib.crc32(key.encode()), self._asked[key]])


def _error_mm(rng: np.random.Generator, spread_mm: float) -> Floats:
    """(3,) normal error along each axis; drawn again while it is larger than what a person would see and correct."""
    while True:
        error = rng.normal(0.0, spread_mm, 3)
        if np.abs(error).max() <= SEEN_SIGMAS * spread_mm:
            return error


def _unsteady(pose: Pose, spread_deg: float, rng: np.random.Generator) -> Pose:
    """The pose with a small random rotation of the brush about its tip."""
    lean = Rotation.from_rotvec([*rng.normal(0.0, spread_deg, 2), 0.0], degrees=True)
    qx, qy, qz, qw = (float(v) for v in (lean * Rotation.from_quat(pose.quaternion)).as_quat())
    return Pose(*pose.position_mm, qx, qy, qz, qw)


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
        if world.motion.target(world.clock.now_s()) is not None or world.motion.held:
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
            joints = joints_for(free, pose, near)
            if joints is None and pose is not lifted:
                joints, pose = self._nearest(reached, pose, near)
            if joints is None:
                continue  # a stretched arm is not lifted along its brush: it swings over at once
            way.append(joints)
            near, reached = joints, pose
        await self._move(way)
        return math.dist(reached.position_mm, aim.position_mm)

    def _nearest(self, start: Pose, end: Pose, near: Joints) -> tuple[Joints | None, Pose]:
        """The joints for the last pose within reach on the straight way to `end`, and that pose, by halving."""
        free = inverted(self._world.motion.tool)
        best, reached, part = None, start, 0.0
        for halving in range(1, HALVINGS + 1):
            pose = interpolate(start, end, part + 0.5**halving)
            if (joints := joints_for(free, pose, near)) is not None:
                best, reached, part = joints, pose, part + 0.5**halving
        return best, reached

    async def _move(self, way: list[Joints]) -> None:
        world, motion = self._world, self._world.motion
        world.hand_guided = True
        try:
            for joints in way:
                motion.add_joints(joints, SPEED_RAD_S, ACC_RAD_S2, world.clock.now_s(), 0.0)
            while motion.target(world.clock.now_s()) is not None:
                await asyncio.sleep(LOOK_S)
        finally:
            world.hand_guided = False
