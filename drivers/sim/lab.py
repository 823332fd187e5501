"""The unknown lab as a whole: the loopback rig on the ports of a real one, and a person with hands on its arm.

The person does what `brushloop sim hand` asks for, which docs/first-day.md and docs/loopback-controller.md explain.
"""

import asyncio
import math
import os
import secrets
import zlib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from brushloop.drivers.arcs.controller import MOVING_ALLOWED, RobotMode
from brushloop.drivers.arcs.wire import AUBOPE_PORT
from brushloop.drivers.devices import Pose
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL
from brushloop.drivers.geometry import of_vector, product, turned, unit
from brushloop.drivers.loopback import LoopbackServer, RigRefused
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.lab_facts import (
    CAMERA_PORTS,
    LIFT_MM,
    PICTURE_PX,
    PIN_TILT_DEG,
    Trap,
    draw,
    held,
    reaches,
    trapped,
)
from brushloop.drivers.sim.rig import PORTS, LoopbackRig
from brushloop.drivers.sim.scene import MjpegServer, Scene

HAND_MM, BY_EYE_MM = 0.3, 1.0
"""Standard deviation of a tip that touches a thing, and of one that is brought near it by eye, along each axis."""
SEEN_SIGMAS = 2.5
"""A person sees errors beyond this many standard deviations, and corrects the part that is beyond."""
GUIDED_MM_S, GUIDED_MM_S2 = 200.0, 800.0
"""How fast a person guides the tip."""
LOOK_S = 0.005
PUSH_N, PUSH_S = 2.0, 1.0
PUSHES = ((0.0, 0.0, -PUSH_N), (PUSH_N, 0.0, 0.0), (0.0, PUSH_N, 0.0))
"""Forces in the brush's frame, N: along the brush toward the flange, then along its x and y."""
GRIPS = (
    (3.0, 0.0, 0.0, (0.0, 0.0)),
    *((28.0, toward_deg, 0.0, (0.0, 0.0)) for toward_deg in (270.0, 90.0, 0.0, 180.0)),
    (22.0, 45.0, 0.0, (-0.17, -0.17)),
    (22.0, 135.0, 0.0, (0.17, -0.17)),
    (22.0, 225.0, 0.0, (0.17, 0.17)),
    (22.0, 315.0, 0.0, (-0.17, 0.17)),
    (25.0, 60.0, 90.0, (0.0, 0.0)),
)
"""How a person is asked to hold the board: flat, slanted to each side, in the four corners, and turned by a quarter.

Each is its slant, the side toward which it slants and its turn in the picture, in degrees, and its place to the right
and down, in shares of the picture's width and height.
"""
TOUCHED = ("pin", "board-corner", "sheet-corner", "well-rim", "wash-rim")
THINGS = (*TOUCHED, "upright", "well", "wash-pot", "park", "clear-view", "hold-board", "push-sensor")
"""Those that the tip touches, and those to which it is brought by eye."""


class UnknownLab(LoopbackRig):
    """`async with UnknownLab(seed) as lab:` serves until the block ends; `hand` asks the person for something.

    An error of the hand depends on the seed, the thing, and how often it was asked for.
    """

    def __init__(
        self, seed: int, trap: str | None = None, *, rate: float = 1.0, picture_px: tuple[int, int] = PICTURE_PX
    ) -> None:
        """Raises `RigRefused` for an unknown trap."""
        if trap is not None and trap not in [*Trap]:
            raise RigRefused(f"--trap is {trap!r}, allowed: {', '.join(Trap)}")
        clean = draw(seed, rate, picture_px)
        self.facts, self._mended = (clean, clean) if trap is None else trapped(clean, Trap(trap))
        """The lab as it is now, and once the mistake is corrected."""
        [other_port] = {*CAMERA_PORTS} - {self.facts.camera_port}
        super().__init__(
            self.facts.config,
            # another address each time, so that no client of an earlier lab finds it
            f"127.{16 + seed % 200}.{os.getpid() % 250 + 1}.{secrets.randbelow(250) + 1}",
            {**PORTS, "camera": self.facts.camera_port, "room": other_port, "older": AUBOPE_PORT},
        )
        self.streams = tuple(f"http://{self.host}:{port}/stream.mjpg" for port in CAMERA_PORTS)
        """The addresses on the stickers of the cameras."""
        self.can_bus = f"{self.host}:{PORTS['force']}/{LOOPBACK_CHANNEL}"
        """The gateway and bus of the force sensor."""
        self.arcs.cabinet.tcp_offset = list(self.facts.cabinet_tcp)
        self.arcs.cabinet.payload = [self.facts.payload_kg, [0.0] * 3, [0.0] * 3, [0.0] * 6]
        self._asked: Counter[str] = Counter()
        noise = np.random.default_rng([seed, 17])
        # a wall, and no sheet
        self.servers["room"] = MjpegServer(self.world, lambda _: noise.normal(185.0, 2.0, (480, 640)).astype(np.uint8))
        if not self.facts.speaks_arcs:
            del self.servers["arcs"], self.servers["rtde"]
            # the software before ARCS takes connections, and answers nothing that ARCS would
            self.servers["older"] = LoopbackServer()
        self._trap = trap
        self._touches = 0
        self._pulled: list[int] = []

    def labels(self, control: Path | None = None) -> list[str]:
        """What a person can read in the lab now: on labels, plugs, the print and the pendant."""
        facts, table, brush = self.facts, self.facts.config.table, self.facts.config.brush
        (columns, rows), (square_mm, marker_mm) = table.board_squares, facts.printed_mm
        ink = "none, a person pours" if self.ink is None else f"{facts.config.ink_device} on {self.ink_path}"
        return [
            "an unknown lab; simulated: nothing measured in it is a result on paper",
            f"robot     the pendant shows the address {self.host}",
            *(f"camera {n}  {stream}" for n, stream in enumerate(self.streams, 1)),
            f"force     SRI M8123 on the gateway {self.can_bus}",
            f"ink       {ink}",
            f"print     ChArUco, {columns} x {rows} squares of {square_mm:g} mm, "
            f"markers of {marker_mm:g} mm, {table.board_dictionary}",
            f"brush     radius R = {brush.radius_mm:g} mm, length L = {brush.length_mm:g} mm, "
            f"press at most {facts.max_depth_mm:g} mm",
            "table     board, blank sheet, pin, a well that holds ink and has a rim to wipe on, pot of water",
            *(() if control is None else (f"hand      brushloop sim hand {control} bring pin",)),
            "Ctrl-C ends",
        ]

    async def hand(self, act: str = "", to: str = "", index: int = 0, corner: str = "") -> str:
        """Ask the person for something; return what was done. Raises ValueError for what cannot be."""
        match act:
            case "bring":
                return await self.bring(to, index, corner)
            case "measure":
                return self._measured(to)
            case "mend":
                return await self.mend()
            case _:
                raise ValueError(f"act = {act!r} is not one of bring, measure, mend")

    async def bring(self, to: str, index: int = 0, corner: str = "") -> str:
        """Guide the tip to one of `THINGS`, or hold or push it; return what was done. Raises as `hand` does."""
        if to not in THINGS:
            raise ValueError(f"to = {to!r} is not one of {', '.join(THINGS)}")
        self.scene.held = self._grip(index) if to == "hold-board" else None
        if to == "hold-board":
            return "I hold the print before the camera."
        if to == "push-sensor":
            await self._push(index)
            return "I pushed the tip for a second."
        aim = self.aim(to, index, corner)
        self._take_hold()
        short_mm = await self.guide(aim, along_brush=to == "pin")
        if to in TOUCHED:
            self._touches += 1
        if self._touches == self.facts.cable_after and not self._pulled:  # somebody trips over it
            lost = ((Device.ROBOT, "deaf"), (Device.TELEMETRY, "mute"))
            self._pulled = [self.faults.hang(Fault(device=d, kind=kind, count=ALWAYS)) for d, kind in lost]
        if short_mm > 0.0:
            raise ValueError(f"The arm is fully stretched, {short_mm:.0f} mm short of the {to}.")
        return f"The tip is at the {to}{f', {corner}' if corner else ''}."

    async def mend(self) -> str:
        """Correct the mistake that the trap is; return what was done."""
        if self._trap is None:
            return "Nothing is wrong that I know of."
        was, self.facts = self.facts, self._mended
        for ident in self._pulled:
            self.faults.take(ident)
        if not was.speaks_arcs:
            await self.servers.pop("older").stop()
            self.servers |= {"arcs": self.arcs, "rtde": self.rtde}
            await self.start("arcs")
            await self.start("rtde")
        if self.facts.cabinet_tcp != was.cabinet_tcp:
            self.arcs.cabinet.tcp_offset = list(self.facts.cabinet_tcp)
        if self.facts.config != was.config:  # table, view or sensor; tool and brush stay
            self.config = self.world.config = self.facts.config
            self.scene = Scene(self.world)
        done, self._trap = f"I have corrected this: {self._trap}.", None
        return done

    def aim(self, to: str, index: int, name: str) -> Pose:
        """Pose of the tip for a thing. Raises ValueError for one that the lab does not have."""
        rng, place = self._luck(to, index, name), self.facts.place(to, name)
        turn_deg = float(rng.normal(0.0, 5.0))
        tilt_deg, toward_deg = 0.0, 0.0
        if to == "pin":
            # The brush leans to each of four sides in turn; in every second round the sides lie between those of the
            # first, and from round to round the wrist turns.
            tilt_deg = PIN_TILT_DEG + float(rng.uniform(-4, 0))
            toward_deg = 90.0 * index + 45.0 * (index // 4 % 2) + float(rng.uniform(-8, 8))
            turn_deg += (0.0, 70.0, -70.0)[index // 4 % 3]
        elif to == "upright":
            turn_deg += (0.0, 100.0, -100.0, 50.0, -50.0)[index % 5]
        spread_mm = HAND_MM if to in TOUCHED else BY_EYE_MM
        error_mm = np.clip(rng.normal(0.0, spread_mm, 3), -SEEN_SIGMAS * spread_mm, SEEN_SIGMAS * spread_mm)
        x, y, z = (np.array(place) + error_mm).tolist()
        aimed = held((x, y, z), turn_deg=turn_deg, tilt_deg=tilt_deg, toward_deg=toward_deg)
        upright_deg = 0.15 if to == "upright" else 1.0  # against a set square, or by eye
        about_x, about_y = np.radians(rng.normal(0.0, upright_deg, 2)).tolist()
        return Pose(x, y, z, *product(of_vector((about_x, about_y, 0.0)), aimed.quaternion))

    def _grip(self, index: int) -> Pose:
        """How the board is held before the camera: each time at another slant and in another part of the picture."""
        rng, view, table = self._luck("hold-board", index, ""), self.facts.config.view, self.facts.config.table
        slant_deg, toward_deg, turn_deg, (x, y) = GRIPS[index % len(GRIPS)]
        size_x_mm, size_y_mm = table.board_size_mm
        high = view.height_px / view.width_px
        longest = max(size_x_mm, size_y_mm / high) if abs(turn_deg) < 45.0 else max(size_y_mm, size_x_mm / high)
        across_mm = longest / float(rng.uniform(0.85, 0.95))
        toward = math.radians(toward_deg + float(rng.uniform(-15, 15)))
        slant = math.radians(slant_deg + float(rng.uniform(-3, 3)))
        turn = math.radians(turn_deg + float(rng.normal(0.0, 4.0)))
        slanted = of_vector((slant * math.cos(toward), slant * math.sin(toward), 0.0))
        turned_too = product(slanted, of_vector((0.0, 0.0, turn)))
        return Pose(x * across_mm, y * across_mm * high, view.focal * across_mm, *turned_too)

    def _measured(self, what: str) -> str:
        """A length as the person writes it down. Raises ValueError for one that nobody can measure."""
        table = self.facts.config.table
        lengths_mm = {"square": table.board_square_mm, "marker": table.board_marker_mm}
        if what not in lengths_mm:
            raise ValueError(f"to = {what!r} is not one of {', '.join(lengths_mm)}")
        return f"{round(lengths_mm[what], 2):g}"

    def _luck(self, to: str, index: int, name: str) -> np.random.Generator:
        key = f"{to} {index} {name}"
        self._asked[key] += 1
        return np.random.default_rng([self.facts.config.seed, 31, zlib.crc32(key.encode()), self._asked[key]])

    async def _push(self, index: int) -> None:
        """Push the tip for `PUSH_S`, in the direction of this index of `PUSHES`."""
        self.world.push_n = turned(unit(self.world.tool().quaternion), PUSHES[index % len(PUSHES)])
        try:
            await asyncio.sleep(PUSH_S)
        finally:
            self.world.push_n = (0.0, 0.0, 0.0)

    def _take_hold(self) -> None:
        """Power the arm at the pendant. Raises ValueError where it cannot be guided."""
        world, power = self.world, self.arcs.cabinet.power
        if power.safety not in MOVING_ALLOWED:
            raise ValueError(f"The pendant shows {power.safety.value}: that has to be ended first.")
        if world.target() is not None or world.motion.held:
            raise ValueError("The arm moves by itself; I keep my hands off.")
        power.then((0.0, RobotMode.RUNNING))

    async def guide(self, aim: Pose, *, along_brush: bool = False) -> float:
        """Lift, swing over, lower; return by how many mm the aim was missed because it is out of reach.

        The last stretch leads down, or along the brush; a place that the arm does not reach is passed over.
        """
        reached = self.world.tool()
        above = _withdrawn(aim) if along_brush else replace(aim, z_mm=aim.z_mm + LIFT_MM)
        self.world.hand_guided = True
        try:
            for pose in (_withdrawn(reached), above, aim):
                if reaches(self.config, [pose]):
                    self.world.motion.add(pose, GUIDED_MM_S, GUIDED_MM_S2, self.world.clock.now_s())
                    reached = pose
            while self.world.target() is not None:
                await asyncio.sleep(LOOK_S)
        finally:
            self.world.hand_guided = False
        return math.dist(reached.position_mm, aim.position_mm)


def _withdrawn(tip: Pose) -> Pose:
    """The tip drawn back along the brush."""
    back_mm = turned(unit(tip.quaternion), (0.0, 0.0, -LIFT_MM))
    x, y, z = (a + b for a, b in zip(tip.position_mm, back_mm, strict=True))
    return Pose(x, y, z, *tip.quaternion)
