"""Errors of devices. Each names the device, the operation, the physical state that it leaves, and what to do.

DeviceError
 +-- NotConnected           never connected, or closed
 +-- ConnectionLost         the peer went away during an operation
 +-- DeviceTimeout          no answer in time
 |    +-- Stale             the newest sample is too old to act on
 +-- Stuck                  samples come, and all are the same
 +-- ProtocolViolation      bytes outside the wire format
 +-- RpcError               the controller answered with an error object
 +-- LimitExceeded          refused before anything moved
 +-- MotionError
      +-- MotionRefused     the controller did not accept the command
      +-- MotionFailed      accepted, but the arm did not arrive
      +-- RobotNotSafe      protective, safeguard or emergency stop, violation or fault
      +-- NotPowered        somebody has switched the arm off
      +-- ArmMoved          another client or a person has moved the arm, or is moving it
      +-- PathDisturbed     another client interfered with lines that were being carried out
      +-- SettingsChanged   the tool offset, or another setting that a press depends on, has changed

On a computer that is too busy, frames, forces and replies come late and no device is at fault: `too_busy` says so.
"""

import os
from typing import ClassVar


class DeviceError(Exception):
    """A device failed: `condition` is the physical state it leaves, `remedy` what the operator must do.

    A class whose errors all leave the same state, or need the same remedy, says so once.
    """

    exit_code: ClassVar[int] = 4
    condition: str = ""
    remedy: str = ""

    def __init__(self, device: str, op: str, what: str, *, condition: str = "", remedy: str = "") -> None:
        self.device = device
        self.op = op
        self.what = what
        self.condition = condition or self.condition
        self.remedy = remedy or self.remedy
        parts = (f"{device}: {op}: {what}.", self.condition, self.remedy)
        super().__init__(" ".join(part for part in parts if part))


class NotConnected(DeviceError):
    """The device was used before `connect` or after `close`."""


class ConnectionLost(DeviceError, ConnectionError):
    """The peer closed the connection, or the cable was disconnected."""


class DeviceTimeout(DeviceError, TimeoutError):
    """The device did not answer in time. The message says if this computer is too busy."""

    def __init__(self, device: str, op: str, what: str, *, condition: str = "", remedy: str = "") -> None:
        super().__init__(device, op, what, condition=condition, remedy=f"{too_busy()} {remedy}".strip())


class Stale(DeviceTimeout):
    """The newest sample is older than allowed; `age_ms` is its age."""

    def __init__(self, device: str, age_ms: float, limit_ms: float, *, remedy: str = "") -> None:
        self.age_ms = age_ms
        what = f"newest sample is {age_ms:.0f} ms old, limit {limit_ms:.0f} ms"
        super().__init__(device, "latest", what, remedy=remedy)


class Stuck(DeviceError):
    """A sensor sends the same values again and again: it no longer measures."""

    remedy = "Switch the sensor's board off and on, and check its wiring."

    def __init__(self, device: str, alike_ms: float, samples: int) -> None:
        what = f"the sensor is stuck: {samples} samples in {alike_ms:.0f} ms were exactly alike, without any noise"
        super().__init__(device, "latest", what)


class ProtocolViolation(DeviceError, ValueError):
    """The peer sent bytes that the wire format does not allow."""


class RpcError(DeviceError):
    """The controller answered with a JSON-RPC error object."""

    def __init__(self, device: str, op: str, code: int, message: str) -> None:
        self.code = code
        self.message = message
        super().__init__(device, op, f"controller answered error {code}: {message}")


class LimitExceeded(DeviceError, ValueError):
    """A target lies outside the configured limits; nothing has moved."""

    condition = "Nothing has moved."

    def __init__(
        self, device: str, field: str, value: float, low: float, high: float, unit: str, *, remedy: str = ""
    ) -> None:
        self.field = field
        what = f"{field} = {value:.3f} {unit} is outside [{low:.3f}, {high:.3f}] {unit}"
        super().__init__(device, "check", what, remedy=remedy)


class MotionError(DeviceError):
    """A motion did not happen as asked."""


class MotionRefused(MotionError):
    """The controller refused the command; `code` is its return code."""

    condition = "The arm has not moved."

    def __init__(self, device: str, op: str, code: int, name: str, remedy: str) -> None:
        self.code = code
        super().__init__(device, op, f"refused with {code} ({name})", remedy=remedy)


class MotionFailed(MotionError):
    """The command was accepted but the arm did not arrive within tolerance and time."""

    condition = "A stop was sent to the arm."


class RobotNotSafe(MotionError):
    """The safety mode forbids motion; the message has the controller's name for it."""


class NotPowered(MotionError):
    """The arm has no power, or its brakes are on, although it was enabled."""

    condition = "The arm has not moved."
    remedy = "Find out who switched the arm off, and why. Enabling it again powers it and releases its brakes."

    def __init__(self, device: str, op: str) -> None:
        super().__init__(device, op, "robot mode is not Running: the arm was switched off")


class ArmMoved(MotionError):
    """The arm is not where it was left; `moving` is True if it still moves."""

    condition = "Another client or a person moved the arm; nothing was sent to it."
    remedy = "Clear the way of the brush: the first motion lifts it back along the tool axis."

    def __init__(self, device: str, op: str, off_mm: float, off_deg: float, *, moving: bool = False) -> None:
        self.moving = moving
        what = f"the arm is {off_mm:.1f} mm and {off_deg:.1f} deg from where it was left"
        if moving:
            what = "the arm is moving, but brushloop does not move it"
        remedy = "Wait until the arm rests, and close the other client." if moving else ""
        super().__init__(device, op, what, remedy=remedy)


class PathDisturbed(MotionError):
    """The controller held lines that are not ours, or the tip left the path of ours; the arm was stopped."""

    condition = "Another client of the controller, or a person at the pendant, interfered; a stop was sent."
    remedy = "Close the other client: a script, another program, a second brushloop."


class SettingsChanged(MotionError):
    """Settings of the controller have changed; the message gives each as found and as it was set."""

    condition = "Nothing was sent to the arm; the tip may be elsewhere than reported."
    remedy = "Find out who changed the settings, a person or another client. Enabling the arm again restores them."


LOAD_PER_CORE = 2.0
"""Mean load of the last minute from which on the computer is too busy: each program then waits as long as it runs."""


def too_busy() -> str:
    """A sentence for the message of anything that came late, with its evidence; empty if this computer is not busy."""
    cores = os.cpu_count() or 1
    if not hasattr(os, "getloadavg") or (load := os.getloadavg()[0]) < LOAD_PER_CORE * cores:
        return ""
    return f"This computer is too busy (load {load:.1f} on {cores} cores): end other programs first."
