"""Step 1: find the arm. Its address is asked for; everything else is read, and nothing is set, powered or moved."""

from __future__ import annotations

import math
from pathlib import Path

from brushloop.collect.errors import CannotTeach
from brushloop.collect.rig.doctor import Finding
from brushloop.collect.rig.report import Scrubber, numbers_only, transcript, write_archive
from brushloop.collect.teach.arm import Address, Cabinet, answers, find_framing, reading
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.store import Notebook
from brushloop.drivers.arcs.controller import MOVING_ALLOWED
from brushloop.drivers.arcs.robot import AUBOPE_PORT

RTDE_PORT = 30010
NAMES = {
    "robot.host": "<host>",
    "aside.address": "<host>",
    "camera.source": "<camera>",
    "aside.sources": "<camera>",
    "force.host": "<host>",
    "aside.bus": "<host>",
    "ink.device.port": "<port>",
}
"""Values that identify the lab, and the placeholder for each."""
LONGEST_TOOL_MM, SHORTEST_TOOL_MM = 600.0, 10.0
"""Plausible distances from the flange to the tip of a brush."""


class ArmStep(Step):
    """Address, ports, framing, model, firmware, safety state, and what the cabinet says of tool and payload."""

    name = "arm"
    title = "Find the arm"
    minutes = 3
    needs = ()

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
        rtde = RTDE_PORT
        if address.port != Address("").port:
            question = f"Port that sends poses ({RTDE_PORT} on a cabinet; press Enter unless yours differs)"
            text = await day.text(question, str(RTDE_PORT))
            rtde = int(text) if text.isdecimal() and 0 < int(text) < 65536 else RTDE_PORT
        pushed = await answers(address.host, rtde)
        with day.together():
            self._keep(day, address, cabinet, rtde if pushed else None)

    async def _address(self, day: Day) -> Address:
        question = "Address of the cabinet (pendant: Settings, Network), as 192.0.2.7 or 192.0.2.7:30004"
        try:
            address = Address.of(await day.text(question, str(day.notebook.get("aside.address") or "")))
        except ValueError as error:
            raise CannotTeach(f"{error}.", "Type the address that the pendant shows.") from None
        day.keep("arm", "aside.address", str(address), "typed")
        there = await answers(address.host, address.port)
        if there == (address.port == AUBOPE_PORT) and await answers(address.host, AUBOPE_PORT):
            raise CannotTeach(
                f"{address.host} answers on port {AUBOPE_PORT}, where the older software AUBOPE (V4) listens, and not "
                "where ARCS does:",
                "it is not supported. Ask the maker for the upgrade to ARCS.",
            )
        if not there:
            raise CannotTeach(
                f"nothing answers at {address}.",
                "Check the address on the pendant, the cable, and that this computer is in the same network; then try "
                "again.",
            )
        return address

    def _keep(self, day: Day, address: Address, cabinet: Cabinet, rtde: int | None) -> None:
        as_set = "as set on the pendant"
        day.keep("arm", "robot.kind", "aubo-arcs", f"{cabinet.model} ({cabinet.box}) answered, {cabinet.firmware}")
        day.keep("arm", "robot.host", address.host, "typed, and answered")
        day.keep("arm", "robot.port", address.port, "answered")
        day.keep("arm", "robot.framing", cabinet.framing, "the first that the controller answered")
        if rtde is not None:
            day.keep("arm", "robot.rtde_port", rtde, "answered, and sends poses")
        day.keep("arm", "robot.payload_kg", cabinet.payload_kg, as_set, "kg", known="not weighed")
        day.keep("arm", "robot.payload_cog_mm", list(cabinet.payload_cog_mm), as_set, "mm", known="not measured")
        if cabinet.collision_level:
            day.keep("arm", "robot.collision_level", cabinet.collision_level, as_set)
        day.keep("arm", "aside.pendant_tcp_mm", list(cabinet.tcp_mm_deg[:3]), as_set)
        day.keep("arm", "aside.simulated", cabinet.simulated, "as the controller reports")

    def summary(self, notebook: Notebook) -> str:
        """The address."""
        return f"{notebook.get('robot.host')}:{notebook.get('robot.port')}"


def doubtful_tool(cabinet: Cabinet) -> str:
    """What is wrong with the tool set on the pendant, and what it means; empty if it is plausible."""
    length_mm = math.hypot(*cabinet.tcp_mm_deg[:3])
    if length_mm > LONGEST_TOOL_MM and SHORTEST_TOOL_MM <= length_mm / 1e3 <= LONGEST_TOOL_MM:
        wrong, meant_mm = "millimetres were typed where metres are taken", length_mm / 1e3
    elif 0.0 < length_mm < 1.0:
        wrong, meant_mm = "metres were typed where millimetres are taken", 1e3 * length_mm
    elif length_mm > LONGEST_TOOL_MM:
        return f"The pendant's tool is {length_mm:.0f} mm long: no brush is. It is measured in the third step"
    else:
        return ""
    return (
        f"The pendant's tool is {length_mm:.3g} mm long: {wrong}, and {meant_mm:.0f} mm are meant. It is measured in "
        "the third step and replaced"
    )


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{v:.1f}" for v in values)


async def write_first_report(path: Path, notebook: Notebook) -> None:
    """`doctor --report` before there is a `rig.toml`: what is known so far, and what the arm answers word for word.

    `check_report` must have passed. Raises OSError.
    """
    scrubber = Scrubber({str(notebook.get(field) or ""): stands_for for field, stands_for in NAMES.items()})
    how = "" if (kind := notebook.values.get("robot.kind")) is None else kind.how
    typed = str(notebook.get("aside.address") or "")
    known = {
        "framing": notebook.framing,
        "findings": [scrubber.value(Finding("robot", typed, answers=bool(how), notes=how).as_json())],
        "done": notebook.done,
        "taught": numbers_only(notebook.table("")),
        "touched": {name: touch.position_mm for name, touch in notebook.touches.items()},
    }
    address = Address.of(typed) if typed else None
    answers = "" if address is None else await transcript(address.host, address.port, notebook.framing, scrubber)
    write_archive(path, known, {"arcs.jsonl": answers})
