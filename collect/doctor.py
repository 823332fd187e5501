"""Asks every configured device who it is, and says in one table what answers and what is wrong. Powers nothing."""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from typing import Any

from calibrate.errors import CalibrationError
from calibrate.scale import see_board
from collect.config import RigConfig
from collect.rig import make_camera, make_robot
from drivers.arcs.codes import MOVING_ALLOWED, RobotMode
from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.samples import Stamp

CALLS = 20
FRAMES = 5


@dataclass(frozen=True, slots=True)
class Finding:
    """What one device answered."""

    device: str
    address: str
    answers: bool
    identity: str = ""
    firmware: str = ""
    latency_ms: float | None = None
    """Median of several calls; for a camera, the time to a frame exposed after asking."""
    notes: str = ""
    problem: str = ""
    remedy: str = ""

    @property
    def well(self) -> bool:
        """True where nothing needs mending."""
        return self.answers and not self.problem

    def as_json(self) -> dict[str, Any]:
        """Every field, and the verdict."""
        return {**asdict(self), "well": self.well}


async def examine(config: RigConfig, clock: Clock) -> list[Finding]:
    """One finding for each configured device, in the order in which a session connects them."""
    robot_address = f"{config.robot.host}:{config.robot.port}"
    return [
        await _asked("camera", config.camera.source, lambda: _camera(config, clock)),
        await _asked("robot", robot_address, lambda: _robot(config, clock, robot_address)),
    ]


async def _asked(device: str, address: str, ask: Callable[[], Awaitable[Finding]]) -> Finding:
    try:
        return await ask()
    except DeviceError as error:
        remedy = error.remedy or "Check power, cable and address."
        return Finding(device, address, answers=False, problem=f"{error.op}: {error.what}", remedy=remedy)


async def _camera(config: RigConfig, clock: Clock) -> Finding:
    notices: list[str] = []
    camera = make_camera(config, clock, notices.append)
    try:
        identity = await camera.connect()
        frame = await camera.fresh(Stamp(clock.now_ns()))
        waits_ms: list[float] = []
        for _ in range(FRAMES):
            asked = time.perf_counter()
            frame = await camera.fresh(Stamp(clock.now_ns()))
            waits_ms.append((time.perf_counter() - asked) * 1e3)
    finally:
        await camera.close()
    board, problem, remedy = await asyncio.to_thread(_board, config, frame.image)
    return Finding(
        "camera",
        config.camera.source,
        answers=True,
        identity=identity.model,
        latency_ms=statistics.median(waits_ms),
        notes="; ".join([board, *notices]),
        problem=problem,
        remedy=remedy,
    )


def _board(config: RigConfig, image: Any) -> tuple[str, str, str]:
    try:
        plane = see_board(image, config.board)
    except CalibrationError as error:
        return "", f"board: {error.what}", "Put the configured board into view, in focus and evenly lit."
    return f"board: {plane.corners} corners, residual {plane.rms_px:.2f} px, {plane.mm_per_px:.4f} mm/px", "", ""


async def _robot(config: RigConfig, clock: Clock, address: str) -> Finding:
    notices: list[str] = []
    robot = make_robot(config, clock, notices.append)
    try:
        identity = await robot.connect()
        state = await robot.condition(CALLS)
    finally:
        await robot.close()
    condition = f"{state.mode}, safety {state.safety}" + (", simulated" if identity.simulated else "")
    problem = remedy = ""
    if state.safety not in MOVING_ALLOWED:
        problem, remedy = f"safety mode is {state.safety}", "Look at the pendant; nothing is cleared from here."
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
