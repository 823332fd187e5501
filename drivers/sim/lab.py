"""The unknown lab as a whole: the loopback rig on an address and on the ports of a real one, and a person in it.

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
import contextlib
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from brushloop.drivers.arcs.robot import AUBOPE_PORT
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL
from brushloop.drivers.server import LoopbackServer
from brushloop.drivers.sim.config import View
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.lab_facts import PICTURE_PX, Trap, draw, trapped
from brushloop.drivers.sim.mjpeg_server import MjpegServer
from brushloop.drivers.sim.person import TOUCHED, Person
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.drivers.sim.scene import Wall

PRESS_SHARE = 0.45
"""Deepest press, as a share of the free length, that the maker of the brush allows."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Labels, plugs and print of one lab."""

    host: str
    """Address on the pendant's network page."""
    streams: tuple[str, ...]
    """Addresses on the stickers of the cameras."""
    can: tuple[str, int, str]
    """Host, port and bus of the CAN gateway with the force sensor."""
    ink: tuple[str, str] | None
    """Kind and serial line of the device at the well; None where a person pours."""
    squares: tuple[int, int]
    square_mm: float
    marker_mm: float
    dictionary: str
    radius_mm: float
    length_mm: float
    max_depth_mm: float

    def lines(self) -> list[str]:
        """For a person to read."""
        host, port, bus = self.can
        ink = "none, a person pours" if self.ink is None else f"{self.ink[0]} on {self.ink[1]}"
        return [
            "an unknown lab; simulated: nothing measured in it is a result on paper",
            f"robot     the pendant shows the address {self.host}",
            *(f"camera    {stream}" for stream in self.streams),
            f"force     SRI M8123 on the gateway {host}:{port}/{bus}",
            f"ink       {ink}",
            f"print     ChArUco, {self.squares[0]} x {self.squares[1]} squares of {self.square_mm:g} mm, "
            f"markers of {self.marker_mm:g} mm, {self.dictionary}",
            f"brush     radius R = {self.radius_mm:g} mm, length L = {self.length_mm:g} mm, "
            f"press at most {self.max_depth_mm:g} mm",
        ]


ARCS_PORT, RTDE_PORT, CAN_PORT = 30004, 30010, 29536
CAMERA_PORTS = (8080, 8081)
PORTS = (ARCS_PORT, RTDE_PORT, CAN_PORT, *CAMERA_PORTS, AUBOPE_PORT)
ROOM_FPS = 5.0
MOST_ROUNDS = 3.0
"""The sensor's rounds come faster with simulated time, up to this many times: what one process can send and read."""
THINGS = (
    *("pin", "upright", "board-corner", "sheet-corner", "well", "well-rim", "wash-pot", "wash-rim"),
    *("park", "clear-view", "hold-board", "push-sensor"),
)
ADDRESSES = 200
"""How many labs of one seed can be open at once on a machine."""


class OlderSoftware(LoopbackServer):
    """The port of the software before ARCS: it takes connections, and answers nothing that ARCS would."""

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read until the client disconnects."""
        while await reader.read(4096):
            pass


class UnknownLab:
    """`async with UnknownLab(seed) as lab:` serves until the block ends; `obey` asks the person for something."""

    def __init__(
        self, seed: int, trap: Trap | None = None, *, rate: float = 1.0, picture_px: tuple[int, int] = PICTURE_PX
    ) -> None:
        clean = draw(seed, rate, picture_px)
        self.facts, self._mended = (clean, clean) if trap is None else trapped(clean, trap)
        self.host = _free_address(seed)
        config = replace(
            self.facts.config,
            arcs_port=ARCS_PORT,
            rtde_port=RTDE_PORT,
            camera_port=CAMERA_PORTS[self.facts.sheet_camera],
            force_port=CAN_PORT,
            force_hz=self.facts.config.force_hz * min(max(rate, 1.0), MOST_ROUNDS),
        )
        self.rig = LoopbackRig(config, self.host)
        self.world = self.rig.world
        self.cabinet = self.rig.arcs.cabinet
        self.cabinet.tcp_offset = list(self.facts.cabinet_tcp)
        self.cabinet.payload = [self.facts.payload_kg, [0.0] * 3, [0.0] * 3, [0.0] * 6]
        self.person = Person(self.cabinet, self.facts)
        self._room = MjpegServer(Wall(self.world), View(fps=ROOM_FPS, jpeg_quality=80))
        self._older = OlderSoftware()
        self._touches = 0
        self._pulled: list[int] = []
        self._busy = asyncio.Lock()
        """The person does one thing at a time."""

    async def __aenter__(self) -> UnknownLab:
        await self.rig.__aenter__()
        try:
            await self._room.start(self.host, CAMERA_PORTS[1 - self.facts.sheet_camera])
            if self.facts.trap is Trap.OLD_SOFTWARE:
                await self.rig.arcs.stop()
                await self.rig.rtde.stop()
                await self._older.start(self.host, AUBOPE_PORT)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._older.stop()
        await self._room.stop()
        await self.rig.__aexit__()

    def seen(self) -> Seen:
        """What a person can read in the lab now."""
        ink, facts, brush = self.rig.ink, self.facts, self.facts.config.brush
        kind = "modbus-pump" if facts.config.ink_device == "pump" else "ink-station"
        return Seen(
            self.host,
            tuple(f"http://{self.host}:{port}/stream.mjpg" for port in CAMERA_PORTS),
            (self.host, CAN_PORT, LOOPBACK_CHANNEL),
            None if ink is None else (kind, ink.path),
            squares=facts.config.table.board_squares,
            square_mm=facts.printed_square_mm,
            marker_mm=facts.printed_marker_mm,
            dictionary=facts.config.table.board_dictionary,
            radius_mm=brush.radius_mm,
            length_mm=brush.length_mm,
            max_depth_mm=round(PRESS_SHARE * brush.length_mm),
        )

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
                    return {"says": self.person.measure(to)}
                case "mend":
                    return {"says": await self.mend()}
                case "plug":
                    return {"says": self.plug()}
                case _:
                    raise ValueError(f"act = {act!r} is not one of bring, measure, mend, plug")

    async def bring(self, to: str, index: int = 0, corner: str = "") -> dict[str, Any]:
        """Carry out `bring`, as in the table above. Raises ValueError for a thing that the lab does not have."""
        if to not in THINGS:
            raise ValueError(f"to = {to!r} is not one of {', '.join(THINGS)}")
        self.rig.scene.held = self.person.grip(index) if to == "hold-board" else None
        if to == "hold-board":
            return {"reached": True, "says": "I hold the print before the camera."}
        if to == "push-sensor":
            await self.person.push(index)
            return {"reached": True, "says": "I pushed the tip for a second."}
        aim = self.person.aim(to, index, corner)
        if (trouble := await self.person.take_hold()) is not None:
            return {"reached": False, "says": trouble}
        short_mm = await self.person.guide(aim, along_brush=to == "pin")
        if to in TOUCHED:
            self._touched()
        if short_mm > 0.0:
            return {"reached": False, "says": f"The arm is stretched out, {short_mm:.0f} mm before the {to}."}
        return {"reached": True, "says": f"The tip is at the {to}{f', {corner}' if corner else ''}."}

    def _touched(self) -> None:
        """Count another touched thing; with one trap, somebody then trips over the cable."""
        self._touches += 1
        if self._touches == self.facts.cable_after:
            lost = ((Device.ROBOT, "deaf"), (Device.TELEMETRY, "mute"))
            self._pulled = [self.rig.faults.hang(Fault(device=d, kind=kind, count=ALWAYS)) for d, kind in lost]

    def plug(self) -> str:
        """Put the cable back."""
        pulled, self._pulled = self._pulled, []
        for ident in pulled:
            self.rig.faults.take(ident)
        return "The cable was out; it is in again." if pulled else "Every cable is in."

    async def mend(self) -> str:
        """Correct the mistake that the trap is; return what was done."""
        was = self.facts
        if was.trap is None:
            return "Nothing is wrong that I know of."
        self.facts = self.person.facts = self._mended
        if was.trap is Trap.CABLE_PULLED:
            return self.plug()
        if self.facts.config != was.config:
            self.rig.reconfigure(self.facts.config)
        if self.facts.cabinet_tcp != was.cabinet_tcp:
            self.cabinet.tcp_offset = list(self.facts.cabinet_tcp)
        if was.trap is Trap.OLD_SOFTWARE:
            await self._older.stop()
            await self.rig.arcs.start(self.host, ARCS_PORT)
            await self.rig.rtde.start(self.host, RTDE_PORT)
        return f"I have seen to it: {was.trap.value}."


def _free_address(seed: int) -> str:
    """A loopback address on which nobody uses a port of ours. Raises OSError where there is none.

    Each process begins its search elsewhere: two that probed one address at the same moment would both find it free.
    """
    for tried in range(ADDRESSES):
        host = f"127.16.{seed % 250 + 1}.{10 + (os.getpid() + tried) % ADDRESSES}"
        with contextlib.ExitStack() as probes:
            try:
                for port in PORTS:
                    probe = probes.enter_context(socket.socket())
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind((host, port))
            except OSError:
                continue
            return host
    raise OSError(f"no loopback address for the lab of seed {seed}: ports {', '.join(map(str, PORTS))} are in use")
