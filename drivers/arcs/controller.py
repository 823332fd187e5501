"""Typed calls to the controller: what is sent over one connection, and what codes, modes and errors mean at the arm."""

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from enum import IntEnum, StrEnum
from typing import Any

from brushloop.drivers.arcs.wire import DEVICE, Framing, RpcConnection, numbers, open_arcs
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import DeviceError, MotionRefused, NotPowered, ProtocolViolation, RobotNotSafe
from brushloop.drivers.geometry import from_wire, to_wire

LOOPBACK_CONTROL_BOX = "brushloop-loopback"
"""What the loopback controller answers to `getControlBoxType`; no maker uses that name."""


class ReturnCode(IntEnum):
    """What move commands return: 0 is success, positive a warning, negative an error of the same number."""

    OK = 0
    BAD_STATE = 1
    QUEUE_FULL = 2
    BUSY = 3
    TIMEOUT = 4
    INVALID_ARGUMENT = 5
    NOT_IMPLEMENTED = 6
    NO_ACCESS = 7
    REQUEST_IGNORED = 13


class RobotMode(StrEnum):
    """The values of `getRobotModeType` that matter here; the spelling is the controller's."""

    BOOTING = "Booting"
    POWER_OFF = "PowerOff"
    POWER_ON = "PowerOn"
    IDLE = "Idle"
    BRAKE_RELEASING = "BrakeReleasing"
    RUNNING = "Running"
    POWERING_OFF = "PowerOffing"


class SafetyMode(StrEnum):
    """The values of `getSafetyModeType` that matter here."""

    NORMAL = "Normal"
    REDUCED = "ReducedMode"
    PROTECTIVE_STOP = "ProtectiveStop"
    SAFEGUARD_STOP = "SafeguardStop"
    SYSTEM_EMERGENCY_STOP = "SystemEmergencyStop"
    ROBOT_EMERGENCY_STOP = "RobotEmergencyStop"


MOVING_ALLOWED = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})

# No software here clears any of them: a person looks first.
CONDITION_AND_REMEDY: dict[str, tuple[str, str]] = {
    SafetyMode.PROTECTIVE_STOP: (
        "The arm is powered, brakes open, and still holds its path.",
        "Find the cause, lift the brush clear, release the protective stop on the pendant.",
    ),
    SafetyMode.SAFEGUARD_STOP: (
        "The arm is powered with brakes on; its path is dropped.",
        "Close the safeguard and reset it at its own input.",
    ),
    SafetyMode.SYSTEM_EMERGENCY_STOP: (
        "The arm has no power and its brakes are on.",
        "Release the system's emergency stop, restart the interface board, power on and start up.",
    ),
    SafetyMode.ROBOT_EMERGENCY_STOP: (
        "The arm has no power and its brakes are on.",
        "Release the pendant's emergency stop, restart the interface board, power on and start up.",
    ),
}
UNKNOWN_CONDITION = (
    "The arm may have stopped anywhere on its path.",
    "Look at the pendant before doing anything else.",
)

REFUSAL_REMEDY = {
    ReturnCode.QUEUE_FULL: "Another client is sending motion; close that client.",
    ReturnCode.BUSY: "Another program controls the arm; stop that program on the pendant.",
}

NOT_RUNNING = -1
"""Return code of a motion in any robot mode but Running."""


class Controller(RpcConnection):
    """One connection, with typed calls. Every method may raise what `call` raises."""

    robot = ""
    """Name of the robot behind it, which `first_robot` tells; to be set before anything else is asked."""
    on_pose: Callable[[Pose, float], None] | None = None
    """Gets each pose that was asked for, and how long the answer took, in s."""

    async def ask(self, method: str, **params: object) -> Any:
        """Call a method of the robot; the answer is unchecked."""
        return await self.call(f"{self.robot}.{method}", params)

    async def ask_numbers(self, method: str, count: int = 6) -> list[float]:
        """So many numbers, or the only one, which a method of the robot answers. Raises `ProtocolViolation`."""
        answer = await self.ask(method)
        return numbers(method.rpartition(".")[2], [answer] if count == 1 else answer, count)

    async def first_robot(self) -> str:
        """Name of the first robot. Raises `ProtocolViolation`."""
        match await self.call("getRobotNames"):
            case [name, *_]:
                return str(name)
            case other:
                raise ProtocolViolation(DEVICE, "getRobotNames", f"expected a list of names, got {other!r}")

    async def pose(self) -> Pose:
        """Where the tip is. Raises `ProtocolViolation`."""
        loop = asyncio.get_running_loop()
        asked_s = loop.time()
        pose = from_wire(await self.ask_numbers("RobotState.getTcpPose"))
        if self.on_pose is not None:
            self.on_pose(pose, loop.time() - asked_s)
        return pose

    async def mode(self) -> str:
        """The robot mode."""
        return str(await self.ask("RobotState.getRobotModeType"))

    async def safety(self) -> str:
        """The safety mode."""
        return str(await self.ask("RobotState.getSafetyModeType"))

    async def require_safe(self, op: str) -> None:
        """Raise `RobotNotSafe`, with condition and remedy, unless the mode allows motion."""
        mode = await self.safety()
        if mode not in MOVING_ALLOWED:
            condition, remedy = CONDITION_AND_REMEDY.get(mode, UNKNOWN_CONDITION)
            raise RobotNotSafe(DEVICE, op, f"safety mode is {mode}", condition=condition, remedy=remedy)

    async def move_line(
        self, target: Pose, speed_mm_s: float, acc_mm_s2: float, blend_mm: float = 0.0, least_s: float = 0.0
    ) -> None:
        """Queue a straight line. Raises `RobotNotSafe` or `MotionRefused`; to be there already is no error.

        The next line may begin `blend_mm` before its end: 0 halts there, else 1 mm to 1 m. It takes at least `least_s`.
        """
        pace = {"a": acc_mm_s2 / 1e3, "v": speed_mm_s / 1e3, "blend_radius": blend_mm / 1e3, "duration": least_s}
        await self._motion("moveLine", pose=to_wire(target), **pace)

    async def at_rest(self) -> bool:
        """True when the queue is empty and the arm is steady."""
        return await self.ask("MotionControl.getExecId") == -1 and await self.ask("RobotState.isSteady") is True

    async def rest(self) -> tuple[bool, Pose]:
        """Whether the arm rests, and where its tip is. Raises `RobotNotSafe`."""
        await self.require_safe("moveLine")
        return await self.at_rest(), await self.pose()

    async def queue(self) -> tuple[int, int]:
        """(id of the running line, -1 for none; lines queued, the running one included). Raises `ProtocolViolation`."""
        running, size = await self.ask("MotionControl.getExecId"), await self.ask("MotionControl.getQueueSize")
        if type(running) is not int or type(size) is not int or size < 0:
            raise ProtocolViolation(DEVICE, "getQueueSize", f"expected two counts, got {running!r} and {size!r}")
        return running, size

    async def idle(self) -> bool:
        """True when the arm rests and no line is left that `release` would let begin.

        Whether a held line counts as running, and so keeps `at_rest` from being true, is not known of a real cabinet.
        """
        return await self.at_rest() and (await self.queue())[1] == 0

    async def hold_path(self) -> None:
        """Let the controller hold its path: it accepts lines and keeps them, but carries out none."""
        await self._motion("stopMove", quick=True, all_tasks=True)

    async def release(self) -> None:
        """End a hold while the arm is `idle`, which moves nothing; the answer is ignored, as there may be no hold."""
        await self.ask("MotionControl.startMove")

    async def go_on(self) -> None:
        """Carry out the lines that were kept. Raises `RobotNotSafe` or `MotionRefused`."""
        await self._motion("startMove")

    async def _motion(self, op: str, **params: object) -> None:
        code = await self.ask(f"MotionControl.{op}", **params)
        if code not in (ReturnCode.OK, ReturnCode.REQUEST_IGNORED):
            await self.require_safe(op)
        accepted(op, code)

    async def halt(self, acc_m_s2: float) -> None:
        """Decelerate along the path, then drop the queue, even if the first call fails."""
        try:
            await self.ask("MotionControl.stopLine", acc=acc_m_s2, acc_rot=acc_m_s2)
        except DeviceError:
            await self.call("RuntimeMachine.abort")
            raise
        await self.call("RuntimeMachine.abort")


def accepted(op: str, code: object) -> None:
    """Raise `MotionRefused` or `NotPowered` for a return code that is neither success nor `already there`."""
    if not isinstance(code, int):
        raise ProtocolViolation(DEVICE, op, f"expected a return code, got {code!r}")
    if code == NOT_RUNNING:
        raise NotPowered(DEVICE, op)
    if code not in (ReturnCode.OK, ReturnCode.REQUEST_IGNORED):
        known = next((member for member in ReturnCode if member == abs(code)), None)
        name, remedy = ("UNKNOWN", "") if known is None else (known.name, REFUSAL_REMEDY.get(known, ""))
        raise MotionRefused(DEVICE, op, code, name, remedy)


@asynccontextmanager
async def only_asking(host: str, port: int, framing: Framing) -> AsyncGenerator[Controller]:
    """Connect to a controller, yield it, and disconnect; for asking, as nothing is set, powered or moved.

    Raises `DeviceError`.
    """
    controller = Controller(host, port, framing=framing)
    try:
        await open_arcs(controller)
        controller.robot = await controller.first_robot()
        yield controller
    finally:
        await controller.close()
