"""Step 1: find the arm. Its address is asked for; everything else is read, and nothing is set, powered or moved."""

from __future__ import annotations

import math

from brushloop.collect.errors import CannotTeach
from brushloop.collect.teach.arm_reader import Address, Cabinet, answers, find_framing, reading
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.store import Notebook, StepName
from brushloop.drivers.arcs.controller import MOVING_ALLOWED
from brushloop.drivers.arcs.robot import AUBOPE_PORT

RTDE_PORT = 30010
LONGEST_TOOL_MM = 600.0
"""Longest plausible distance from the flange to the tip of a brush."""
SHORTEST_TOOL_MM = 10.0


class ArmStep(Step):
    """Address, ports, framing, model, firmware, safety state, and what the cabinet says of tool and payload."""

    name: StepName = "arm"
    title = "Find the arm"
    minutes = 3
    needs: tuple[StepName, ...] = ()

    async def teach(self, day: Day) -> None:
        """Ask for the address and read everything else. Raises `CannotTeach`, `DeviceError`."""
        address = await self._address(day)
        await day.working(f"asking {address} who it is")
        framing = await find_framing(address)
        async with reading(address, framing) as reader:
            cabinet = await reader.cabinet(framing)
        await day.say(
            f"{address} answers in the {framing} framing: {cabinet.model} ({cabinet.box}), {cabinet.firmware}",
            f"robot mode {cabinet.robot_mode}, safety {cabinet.safety_mode}, mode switch {cabinet.operational_mode}",
            f"tool set on the pendant: {_listed(cabinet.tcp_mm_deg[:3])} mm, turned by "
            f"{_listed(cabinet.tcp_mm_deg[3:])} deg; payload {cabinet.payload_kg:g} kg; "
            f"collision level {cabinet.collision_level}",
        )
        if doubt := doubtful_tool(cabinet):
            await day.say(doubt, tone="warning")
        if cabinet.safety_mode not in MOVING_ALLOWED:
            await day.say(
                f"The safety mode is {cabinet.safety_mode}: the arm cannot be guided by hand until it is released.",
                "Look at the pendant; this program clears nothing.",
                tone="warning",
            )
        rtde = await self._rtde(day, address)
        pushed = await answers(address.host, rtde)
        with day.together():
            self._keep(day, address, cabinet, rtde if pushed else None)

    async def _address(self, day: Day) -> Address:
        default = str(day.notebook.get("aside.address") or "")
        question = "Address of the cabinet (pendant: Settings, Network), as 192.0.2.7 or 192.0.2.7:30004"
        try:
            address = Address.of(await day.guide.text(question, default))
        except ValueError as error:
            raise CannotTeach(f"{error}.", "Type the address that the pendant shows.") from None
        day.keep("arm", "aside.address", str(address), "typed")
        if not await answers(address.host, address.port):
            older = await answers(address.host, AUBOPE_PORT)
            raise CannotTeach(*_silent(address, older=older))
        if address.port == AUBOPE_PORT:
            raise CannotTeach(*_silent(address, older=True))
        return address

    def _keep(self, day: Day, address: Address, cabinet: Cabinet, rtde: int | None) -> None:
        day.keep("arm", "robot.kind", "aubo-arcs", f"{cabinet.model} ({cabinet.box}) answered, {cabinet.firmware}")
        day.keep("arm", "robot.host", address.host, "typed, and answered")
        day.keep("arm", "robot.port", address.port, "answered")
        day.keep("arm", "robot.framing", cabinet.framing, "the first that the controller answered")
        if rtde is not None:
            day.keep("arm", "robot.rtde_port", rtde, "answered, and sends poses")
        day.keep("arm", "robot.payload_kg", cabinet.payload_kg, "as set on the pendant", unit="kg", known="not weighed")
        cog_mm = [float(v) for v in cabinet.payload_cog_mm]
        day.keep("arm", "robot.payload_cog_mm", cog_mm, "as set on the pendant", unit="mm", known="not measured")
        if cabinet.collision_level:
            day.keep("arm", "robot.collision_level", cabinet.collision_level, "as set on the pendant")
        day.keep("arm", "aside.pendant_tcp_mm", [float(v) for v in cabinet.tcp_mm_deg[:3]], "as set on the pendant")
        day.keep("arm", "aside.simulated", cabinet.simulated, "as the controller reports")

    async def _rtde(self, day: Day, address: Address) -> int:
        if address.port == Address("").port:
            return RTDE_PORT
        question = f"Port that sends poses ({RTDE_PORT} on a cabinet; press Enter unless yours differs)"
        text = await day.guide.text(question, str(RTDE_PORT))
        return int(text) if text.isdecimal() and 0 < int(text) < 65536 else RTDE_PORT

    def summary(self, notebook: Notebook) -> str:
        """The address."""
        return f"{notebook.get('robot.host')}:{notebook.get('robot.port')}"


def doubtful_tool(cabinet: Cabinet) -> str:
    """What is wrong with the tool set on the pendant, and what it means; empty if it is plausible."""
    length_mm = math.hypot(*cabinet.tcp_mm_deg[:3])
    if length_mm > LONGEST_TOOL_MM:
        if SHORTEST_TOOL_MM <= length_mm / 1e3 <= LONGEST_TOOL_MM:
            return (
                f"The pendant's tool is {length_mm / 1e3:.0f} m long: millimetres were typed where metres are taken, "
                f"and {length_mm / 1e3:.0f} mm are meant. It is measured in the third step and replaced"
            )
        return f"The pendant's tool is {length_mm:.0f} mm long: no brush is. It is measured in the third step"
    if 0.0 < length_mm < 1.0:
        return (
            f"The pendant's tool is {length_mm:.3f} mm long: metres were typed where millimetres are taken, and "
            f"{1e3 * length_mm:.0f} mm are meant. It is measured in the third step and replaced"
        )
    return ""


def _silent(address: Address, *, older: bool) -> tuple[str, str]:
    if older:
        return (
            f"{address.host} answers on port {AUBOPE_PORT}, where the older software AUBOPE (V4) listens, and not "
            "where ARCS does:",
            "it is not supported. Ask the maker for the upgrade to ARCS.",
        )
    return (
        f"nothing answers at {address}.",
        "Check the address on the pendant, the cable, and that this computer is in the same network; then try again.",
    )


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{v:.1f}" for v in values)
