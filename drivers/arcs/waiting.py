"""Wait until the arm is powered or has settled, and explain why it did not. Each poll checks safety first."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from brushloop.drivers.arcs.codes import OutOfReach, RobotMode
from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.rpc import DEVICE
from brushloop.drivers.errors import DeviceError, DeviceTimeout, MotionFailed
from brushloop.drivers.geometry import distance
from brushloop.drivers.samples import Pose

RESTS_ELSEWHERE_S = 1.0
"""How long the arm may rest away from its target: an accepted move may start late, but not later than this."""

STUCK_S = 3.0
PROGRESS = 0.05
"""Smallest approach to the target that counts as progress, mm or deg."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Distance and angle within which the arm counts as arrived."""

    position_mm: float
    rotation_deg: float

    def holds(self, here: Pose, target: Pose) -> bool:
        """Whether `here` is at `target`."""
        off_mm, off_deg = distance(here, target)
        return off_mm <= self.position_mm and off_deg <= self.rotation_deg


async def until_mode(controller: Controller, wanted: set[RobotMode], *, timeout_s: float, poll_s: float) -> None:
    """Return once the robot mode is one of `wanted`. Raises `RobotNotSafe`, `DeviceTimeout`."""
    try:
        async with asyncio.timeout(timeout_s):
            while await controller.mode() not in wanted:
                await controller.require_safe("power on")
                await asyncio.sleep(poll_s)
    except DeviceError:
        raise
    except TimeoutError:
        raise DeviceTimeout(
            DEVICE,
            "power on",
            f"mode {await controller.mode()} did not become {' or '.join(sorted(wanted))}",
            remedy="Look at the pendant: a confirmation may be waiting there.",
        ) from None


Look = Callable[[], Awaitable[tuple[bool, Pose] | DeviceError]]
"""Asks whether the arm rests, and where its tip is. An error that it returns, it does not raise: it is to ask again."""


async def until_settled(
    look: Look,
    target: Pose,
    tolerance: Tolerance,
    *,
    planned_s: float,
    poll_s: float,
) -> None:
    """Return once `look` reports that the arm rests, at a pose within tolerance.

    Raises `MotionFailed` if the arm rests elsewhere, or if twice the planned time has passed and it comes no nearer: an
    arm whose speed was turned down on the pendant is slow, not stuck. An error that `look` returns, instead of raising
    it, is raised only if it still returns one after twice the planned time.
    """
    loop = asyncio.get_running_loop()
    begun_at, allowed_s = loop.time(), 2.0 * planned_s + 3.0
    idle_since: float | None = None
    nearest, nearer_at = math.inf, begun_at
    while True:
        state, now = await look(), loop.time()
        if isinstance(state, DeviceError):
            if now > begun_at + allowed_s:
                raise state
            await asyncio.sleep(poll_s)
            continue
        steady, here = state
        off_mm, off_deg = distance(here, target)
        if off_mm + off_deg < nearest - PROGRESS:
            nearest, nearer_at = off_mm + off_deg, now
        if steady and off_mm <= tolerance.position_mm and off_deg <= tolerance.rotation_deg:
            return
        idle_since = (idle_since or now) if steady else None
        if idle_since is not None and now - idle_since > RESTS_ELSEWHERE_S:
            raise _not_arrived(f"rests {off_mm:.2f} mm and {off_deg:.2f} deg from the target")
        if now > begun_at + allowed_s and now - nearer_at > STUCK_S:
            raise _not_arrived(f"not settled after {allowed_s:.1f} s, {off_mm:.2f} mm and {off_deg:.2f} deg to go")
        await asyncio.sleep(poll_s)


def planned_s(start: Pose, target: Pose, speed_mm_s: float, acc_mm_s2: float) -> float:
    """Upper estimate of a move's duration: the line at speed plus one ramp, or the turn at half a radian per second.

    If the tip moves less than a millimetre, ARCS reads m/s as rad/s.
    """
    translation_mm, rotation_deg = distance(start, target)
    ramp_s = speed_mm_s / acc_mm_s2
    turn_s = math.radians(rotation_deg) / (speed_mm_s / 1e3) if translation_mm < 1.0 else rotation_deg / 30.0
    return max(translation_mm / speed_mm_s, turn_s) + ramp_s


def _not_arrived(what: str) -> MotionFailed:
    return MotionFailed(
        DEVICE,
        "moveLine",
        what,
        condition="A stop was sent to the arm.",
        remedy="Check on the pendant whether the target is within reach, and that no other client stops the arm.",
    )


PLANNING_FAILED = {30047: "pose out of reach", 30048: "planning failed"}
NEWEST = 20


class Messages:
    """The controller's messages since `begin`."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._seen = 0
        """Newest timestamp of the controller seen so far; its unit is unknown, but it increases."""

    async def begin(self) -> None:
        """Skip the messages that are already there; they concern earlier motion."""
        await self._new()

    async def explain(self, error: MotionFailed) -> MotionFailed:
        """`OutOfReach` if a new message reports it, else the error itself."""
        for code in await self._new():
            if code in PLANNING_FAILED:
                return OutOfReach(DEVICE, error.op, code, PLANNING_FAILED[code])
        return error

    async def _new(self) -> list[int]:
        """Codes of the messages not seen before; empty if the controller does not answer."""
        found: Any = []
        with contextlib.suppress(DeviceError):
            found = await self._controller.ask("Trace.peek", num=NEWEST, last_time=self._seen)
        codes: list[int] = []
        newest = self._seen
        for message in found if isinstance(found, list) else []:  # pyright: ignore[reportUnknownVariableType]
            match message:
                case {"code": int(code), "timestamp": int(stamp)} if stamp > self._seen:
                    codes.append(code)
                    newest = max(newest, stamp)
                case _:  # pyright: ignore[reportUnknownVariableType]
                    pass
        self._seen = newest
        return codes
