"""Asks every configured device for its identity and state, and reports in one table what is wrong. Powers nothing."""

from __future__ import annotations

import asyncio
import math
import statistics
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from rich.table import Table
from rich.text import Text

from brushloop.calibrate.board.pix2len import see_board
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import make_robot
from brushloop.drivers.arcs.controller import MOVING_ALLOWED, RobotMode
from brushloop.drivers.camera import OpenCvCamera
from brushloop.drivers.devices import Identity, Stamp
from brushloop.drivers.errors import DeviceError
from brushloop.drivers.force.sri_m8123 import ForceTable, SriM8123
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import InkTable

T = TypeVar("T")
CALLS = 20
FRAMES = 5
LISTEN_S = 0.5
"""How long a force sensor is listened to: a hundred rounds give the rate."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What one device answered."""

    device: str
    address: str
    answers: bool
    identity: str = ""
    firmware: str = ""
    latency_ms: float | None = None
    """Median of several calls; for a camera, the time to a frame exposed after the request."""
    notes: str = ""
    problem: str = ""
    remedy: str = ""

    @property
    def well(self) -> bool:
        """Whether nothing is wrong."""
        return self.answers and not self.problem

    def as_json(self) -> dict[str, Any]:
        """Every field, and the verdict."""
        return {**asdict(self), "well": self.well}


async def examine(config: RigConfig, clock: Clock) -> list[Finding]:
    """One finding for each configured device, in the order in which a session connects them."""
    findings = [await _asked("camera", config.camera.source, lambda: _camera(config, clock))]
    if (force := config.force) is not None:
        findings.append(await _asked("force", _bus(force), lambda: _force(force, clock)))
    if (ink := config.ink.device) is not None:
        findings.append(await _asked("ink", ink.port, lambda: _ink(ink, clock)))
    robot_address = f"{config.robot.host}:{config.robot.port}"
    findings.append(await _asked("robot", robot_address, lambda: _robot(config, clock, robot_address)))
    return findings


async def _asked(device: str, address: str, ask: Callable[[], Awaitable[Finding]]) -> Finding:
    try:
        return await ask()
    except DeviceError as error:
        remedy = error.remedy or "Check power, cable and address."
        return Finding(device, address, answers=False, problem=f"{error.op}: {error.what}", remedy=remedy)


async def _timed(calls: int, ask: Callable[[], Awaitable[T]]) -> tuple[T, float]:
    """The last answer of several calls, and their median time in ms."""
    waits_ms: list[float] = []
    while True:
        began_s = time.perf_counter()
        answer = await ask()
        waits_ms.append((time.perf_counter() - began_s) * 1e3)
        if len(waits_ms) == calls:
            return answer, statistics.median(waits_ms)


async def _camera(config: RigConfig, clock: Clock) -> Finding:
    notices: list[str] = []
    camera = OpenCvCamera(config.camera, clock, notices.append)
    try:
        identity = await camera.connect()
        await camera.fresh(Stamp(clock.now_ns()))
        frame, latency_ms = await _timed(FRAMES, lambda: camera.fresh(Stamp(clock.now_ns())))
    finally:
        await camera.close()
    board, problem, remedy = await asyncio.to_thread(_board, config, frame.image)
    return Finding(
        "camera",
        config.camera.source,
        answers=True,
        identity=identity.model,
        latency_ms=latency_ms,
        notes="; ".join([board, *notices]),
        problem=problem,
        remedy=remedy,
    )


def _board(config: RigConfig, image: Any) -> tuple[str, str, str]:
    try:
        plane = see_board(image, config.board, lens=config.camera.optics)
    except CalibrationError as error:
        return "", f"board: {error.what}", "Put the configured board into view, in focus and evenly lit."
    return f"board: {plane.corners} corners, residual {plane.rms_px:.2f} px, {plane.mm_per_px:.4f} mm/px", "", ""


def _bus(config: ForceTable) -> str:
    gateway = "" if config.host is None else f" at {config.host}:{config.port}"
    return f"{config.interface} {config.channel}{gateway}"


async def _force(config: ForceTable, clock: Clock) -> Finding:
    sensor = SriM8123(config, clock)
    try:
        identity = await sensor.connect()
        await asyncio.sleep(LISTEN_S)
        age_ms = (clock.now_ns() - sensor.latest().stamp.host_ns) / 1e6
        force_n, health = math.hypot(*sensor.latest().force_n), sensor.health()
    finally:
        await sensor.close()
    problem = remedy = ""
    if health.torn or health.refused or health.bus_errors:
        problem = f"{health.torn} torn, {health.refused} refused rounds, {health.bus_errors} bus errors"
        remedy = "Check wiring, shielding and termination."
    elif force_n > config.max_n:
        problem = f"{force_n:.2f} N with nothing pressing, above the ceiling force.max_n = {config.max_n:g} N"
        remedy = "Remove what touches the brush; the bias at each start takes off the weight of the holder."
    return Finding(
        "force",
        _bus(config),
        answers=True,
        identity=identity.model,
        firmware=identity.firmware or "unknown",
        latency_ms=age_ms,
        notes=f"{health.rate_hz:.0f} rounds/s, {force_n:.3f} N before bias" + _simulated(identity),
        problem=problem,
        remedy=remedy,
    )


async def _ink(config: InkTable, clock: Clock) -> Finding:
    device = config.device(clock)
    try:
        identity = await device.connect()
        level, latency_ms = await _timed(CALLS, device.level)
    finally:
        await device.close()
    return Finding(
        "ink",
        config.port,
        answers=True,
        identity=identity.model,
        firmware=identity.firmware or "unknown",
        latency_ms=None if level is None else latency_ms,
        notes=("no gauge" if level is None else f"well {level:.0%} full") + _simulated(identity),
    )


def _simulated(identity: Identity) -> str:
    return ", simulated" if identity.simulated else ""


async def _robot(config: RigConfig, clock: Clock, address: str) -> Finding:
    notices: list[str] = []
    robot = make_robot(config, clock, notices.append)
    try:
        identity = await robot.connect()
        state = await robot.state(CALLS)
    finally:
        await robot.close()
    condition = f"{state.mode}, safety {state.safety}" + _simulated(identity)
    problem = remedy = ""
    if state.safety not in MOVING_ALLOWED:
        problem, remedy = f"safety mode is {state.safety}", "Look at the pendant; this program clears nothing."
    elif state.mode not in (RobotMode.POWER_OFF, RobotMode.IDLE, RobotMode.RUNNING):
        problem, remedy = f"robot mode is {state.mode}", "Look at the pendant."
    return Finding(
        "robot",
        address,
        answers=True,
        identity=identity.model,
        firmware=identity.firmware,
        latency_ms=state.latency_ms,
        notes="; ".join([condition, *notices]),
        problem=problem,
        remedy=remedy,
    )


def doctor_table(findings: list[Finding]) -> Table:
    """One row per device, with the verdict as a word as well as a colour."""
    table = Table("device", "verdict", "who answers", "latency", "notes, what is wrong, what to do", show_lines=True)
    for finding in findings:
        verdict = Text("ok", "green") if finding.well else Text("trouble" if finding.answers else "no answer", "red")
        who = " ".join(part for part in (finding.identity or finding.address, finding.firmware) if part)
        latency = "" if finding.latency_ms is None else f"{finding.latency_ms:.1f} ms"
        words = [finding.notes, finding.problem and f"{finding.problem}.", finding.remedy]
        table.add_row(finding.device, verdict, who, latency, "\n".join(w for w in words if w))
    return table
