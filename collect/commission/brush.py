"""Steps 6 and 7: the brush by calipers, what keeps the well filled, and the force sensor, by a push."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from urllib.parse import urlsplit

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from brushloop.collect.commission.sheet import inside_corners
from brushloop.collect.commission.visit import Notebook, Step, Taught, Visit, choice_of, number_of
from brushloop.collect.errors import NotAccepted
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.rig.check import brush_shorter_than_tool, deepest_press
from brushloop.collect.rig.devices import identified
from brushloop.collect.rig.paper import PaperPlane
from brushloop.drivers.devices import ForceSample
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL, ForceTable, SriM8123
from brushloop.drivers.ink.port import InkTable
from brushloop.drivers.ink.pump import ModbusPumpConfig
from brushloop.drivers.ink.station import InkStationConfig

DEEPEST_SHARE = 0.45
"""A bundle that is pressed deeper than this share of its length comes near to its ferrule."""
PRIME_ML = 0.5
NONE, STATION, PUMP = Choice("n", "a person, by hand"), Choice("i", "an ink station"), Choice("p", "a Modbus pump")
RADIUS = number_of("R: radius of the wet bundle at the ferrule, by calipers", 0.5, 50.0, "mm")
RADIUS_SIGMA_MM, LENGTH_SIGMA_MM = 0.1, 0.5
"""Standard errors of calipers on wet hair."""


def ask_length(offset_mm: Sequence[float]) -> Prompt:
    """The question for L, which is a part of the tool."""
    question = "L: length of the hair from the ferrule to the tip, by calipers"
    return number_of(question, 3.0, 200.0, "mm", check=lambda length_mm: brush_shorter_than_tool(offset_mm, length_mm))


def ask_depth(length_mm: float) -> Prompt:
    """The question for the deepest press."""
    question = f"Deepest press that this brush can take; {DEEPEST_SHARE:.0%} of L is cautious"
    cautious = f"{int(DEEPEST_SHARE * length_mm)}"
    return number_of(question, 1.0, 100.0, "mm", cautious, check=lambda depth_mm: deepest_press(depth_mm, length_mm))


def _line_named(line: str) -> str:
    """The serial line that was typed. Raises ValueError for none."""
    if not line:
        raise ValueError("no serial line was named; `ls -l /dev/serial/by-id /dev/tty*` lists them")
    return line


ASK_PORT = Prompt("Serial line of the device, such as /dev/serial/by-id/usb-…", read=_line_named)
DELIVERY = number_of("Ink per revolution: weigh the ink of ten revolutions, divide by ten", 0.001, 10.0, "ml")


class BrushStep(Step):
    """R, L, deepest press; the ink device."""

    name = "brush"
    title = "Brush and ink"
    minutes = 4
    observes = ("brush.", "ink.device.", "ink.name", "aside.ink")

    async def carry_out(self, visit: Visit) -> None:
        """Ask for what calipers say, and find the device at the well. Raises `NotAccepted`, `DeviceError`."""
        await visit.value("brush.radius_mm", RADIUS, RADIUS_SIGMA_MM)
        ask = ask_length(visit.notebook.get("robot.tcp_offset_mm"))
        length_mm = await visit.value("brush.length_mm", ask, LENGTH_SIGMA_MM)
        await visit.value("brush.max_depth_mm", ask_depth(length_mm))
        await visit.value("brush.name", Prompt("Name of the brush, for the record", default="brush", read=str))
        kind = await visit.value("aside.ink", choice_of("What keeps the ink well filled?", (NONE, STATION, PUMP)))
        if kind != NONE.key and "ink.device.kind" not in visit.notebook.values:
            port = await visit.value("ink.device.port", ASK_PORT)
            device: InkTable = InkStationConfig(kind="ink-station", port=port)
            if kind == PUMP.key:
                ml = await visit.value("ink.device.ml_per_revolution", DELIVERY)
                device = ModbusPumpConfig(kind="modbus-pump", port=port, ml_per_revolution=ml)
            await self._primed(visit, device)
            visit.keep({"ink.device.kind": Taught(device.kind, "the device answered on this line")})
        await visit.value("ink.name", Prompt("Name of the ink, for the record", default="ink", read=str))

    async def _primed(self, visit: Visit, config: InkTable) -> None:
        visit.working(f"asking {config.port} for its name")
        device = config.device(visit.clock)
        async with identified(device) as identity:
            level = await device.level()
            gauge = "no gauge" if level is None else f"well {level:.0%} full"
            visit.say(f"{identity.model} {identity.firmware}: {gauge}")
            while await visit.yes(f"Pump {PRIME_ML:g} ml, and repeat until the tube drips? Keep the well under it."):
                visit.working(f"pumping {PRIME_ML:g} ml")
                await device.dose(min(PRIME_ML, config.dose_ml))
                level = await device.level()
                if level is not None:
                    visit.say(f"well {level:.0%} full")


LOOPBACK_STALE_MS = 1000.0


def _addressed(bus: str) -> dict[str, str | float]:
    """The fields of `[force]` for what was typed; none for an empty text. Raises ValueError."""
    if ":" not in bus:
        return {"kind": "sri-m8123", "interface": "socketcan", "channel": bus} if bus else {}
    parts = urlsplit(f"//{bus}")
    if not parts.hostname or not parts.port:
        raise ValueError(f"{bus!r} is no CAN bus: type can0, or HOST:PORT/can0 of a gateway")
    channel = parts.path.strip("/") or "can0"
    # Simulated time may run faster than rounds arrive.
    stale = {"stale_ms": LOOPBACK_STALE_MS} if channel == LOOPBACK_CHANNEL else {}
    at = {"kind": "sri-m8123", "interface": "socketcand", "channel": channel}
    return {**at, "host": parts.hostname, "port": parts.port, **stale}


def _bus(line: str) -> str:
    _addressed(line)
    return line


ASK_BUS = Prompt("CAN bus of the force sensor: can0, or HOST:PORT/can0 of a gateway; Enter if there is none", read=_bus)
REST_S = 1.0
"""How long the sensor is listened to with nothing touching, before the push and after it."""
LEAST_PUSH_N, MOST_PUSH_N = 0.3, 60.0
"""A finger pushes with more than the first and less than the second: otherwise the scale is wrong."""
MOST_NOISE_N = 0.05
STRAIGHT = 0.8
"""Least share of the push along the sensor's z."""
LEAN_ROOM_DEG = 0.3
"""Room for another sheet on the same table."""
INSET_MM = 6.0
"""Distance of the touch points from the sheet's edges: in its margin, where they cost no patch."""


class ForceStep(Step):
    """Where the sensor is, which way it points, and how zero touch is done."""

    name = "force"
    title = "Force sensor"
    minutes = 3
    observes = ("force.", "touch.", "aside.bus")

    async def carry_out(self, visit: Visit) -> None:
        """Find the sensor and have it pushed. Raises `NotAccepted`, `DeviceError`."""
        bus = await visit.value("aside.bus", ASK_BUS)
        visit.keep({f"force.{field}": Taught(value, "typed") for field, value in _addressed(bus).items()})
        if not bus:
            visit.say("Without a force sensor, you find the paper's height in each session by jogging with keys.")
            return
        if "touch.force.push_axis" not in visit.notebook.values:
            await self._pushed(visit)

    async def _pushed(self, visit: Visit) -> None:
        samples = list[ForceSample]()
        sensor = SriM8123(ForceTable.model_validate(visit.notebook.table("force.")), visit.clock)
        visit.working("listening to the sensor; let nothing touch the brush")
        async with identified(sensor) as identity:
            await sensor.bias(REST_S)
            sensor.listen(samples.append)
            await asyncio.sleep(REST_S)
            noise_n = float(np.std([sample.force_n for sample in samples], axis=0).max()) if samples else math.inf
            noise = f"noise {noise_n:.4f} N (limit: {MOST_NOISE_N:g} N)"
            visit.say(f"{identity.model}: {len(samples) / REST_S:.0f} readings/s, {noise}")
            samples.clear()
            how = "Push the tip gently up with a finger, toward the flange, for a second; then take the finger away."
            await visit.brought("push-sensor 0", how)
            await asyncio.sleep(REST_S)
            force_n = strongest(samples)
        axis = judged_push(force_n, noise_n)
        how = f"a finger pushed the tip with {float(np.linalg.norm(force_n)):.1f} N"
        visit.say(f"✓ {how}, along the brush")
        if axis[2] > 0.0:
            visit.say(
                "The sensor counts a push toward the flange as positive: it is mounted, or wired, the other way round "
                "than usual. push_axis takes this into account; nothing has to be changed."
            )
        visit.keep({"touch.force.push_axis": Taught(axis, how, known="direction within 35 deg, sign certain")})

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """How zero touch is done: by force, or by jogging, at four points."""
        method, why = ("force", "a sensor was found") if notebook.get("aside.bus") else ("jog", "no sensor")
        points = inside_corners(notebook.get("paper.size_mm"), INSET_MM)
        lean_deg = PaperPlane(*notebook.get("aside.plane")).slope_deg
        widest_deg = min(max(math.ceil(10.0 * (lean_deg + LEAN_ROOM_DEG)) / 10.0, 1.0), 3.0)
        leans = f"the sheet leans by {lean_deg:.2f} deg; {LEAN_ROOM_DEG:g} deg of margin were added"
        return {
            "touch.method": Taught(method, why),
            "touch.points_mm": Taught(points.tolist(), f"{INSET_MM:g} mm inside the sheet's corners"),
            "touch.lean_deg": Taught(widest_deg, leans),
        }


def strongest(samples: list[ForceSample], over: int = 20) -> NDArray[np.float64]:
    """(3,) mean of the `over` consecutive samples with the largest force; zeros where there are fewer."""
    forces = np.array([sample.force_n for sample in samples], np.float64).reshape(-1, 3)
    if len(forces) < over:
        return np.zeros(3)
    means = sliding_window_view(forces, over, axis=0).mean(axis=-1)
    return np.asarray(means[int(np.argmax(np.linalg.norm(means, axis=1)))], np.float64)


def judged_push(force_n: NDArray[np.float64], noise_n: float) -> list[float]:
    """The sensor's axis along which the paper pushes, with its sign. Raises `NotAccepted` for an unlikely push."""
    size_n = float(np.linalg.norm(force_n))
    if noise_n > MOST_NOISE_N:
        raise NotAccepted(
            f"the sensor's noise is {noise_n:.3f} N, limit {MOST_NOISE_N:g} N.",
            "Let nothing touch the brush; check shielding and termination.",
        )
    if not LEAST_PUSH_N <= size_n <= MOST_PUSH_N:
        raise NotAccepted(
            f"the push reads {size_n:.3g} N; a finger gives {LEAST_PUSH_N:g} to {MOST_PUSH_N:g} N.",
            "Push harder and longer. Check the sensor's bus, and its scale and unit by its data sheet.",
        )
    if abs(float(force_n[2])) < STRAIGHT * size_n:
        listed = ", ".join(f"{v:+.2f}" for v in force_n.tolist())
        raise NotAccepted(
            f"the push reads ({listed}) N, not along the sensor's z.",
            "Push along the brush; the sensor's z must lie along the tool.",
        )
    return [0.0, 0.0, math.copysign(1.0, float(force_n[2]))]
