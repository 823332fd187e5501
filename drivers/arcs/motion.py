"""Lines for the controller: fed while the arm follows a path, or queued as a whole; and the wait until it has settled.

A path is fed a few lines at a time: few enough that a stop has little to drop, enough that a slow call does not let the
arm run dry with the brush on the paper.

A press is queued as a whole. A program that dies in mid-press must not leave the brush down, so the lift is queued
before the descent begins. The controller holds its path meanwhile (`stopMove`) and is released by one request
(`startMove`): before it nothing moves, and after it nothing more has to come from here. The controller takes lines from
any client, so its queue must hold ours and no other; see `OwnPath`.
"""

import asyncio
import contextlib
import itertools
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace

from brushloop.drivers.arcs.controller import Controller, ReturnCode
from brushloop.drivers.arcs.wire import DEVICE
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    MotionError,
    MotionFailed,
    MotionRefused,
    PathDisturbed,
    ProtocolViolation,
)
from brushloop.drivers.geometry import distance, from_line
from brushloop.drivers.limits import Limits

RESTS_ELSEWHERE_S = 1.0
"""How long the arm may rest away from its target: an accepted move may start late, but not later than this."""

STUCK_S = 3.0
PROGRESS = 0.05
"""Smallest approach to the target that counts as progress, mm or deg."""
ARRIVED_MM, ARRIVED_DEG = 0.05, 0.1
"""How near its target a settled arm is."""
IN_PLACE_MM, IN_PLACE_DEG = 1.0, 0.01
"""For a line shorter than this, and that turns by more, ARCS reads the speed as that of the turn: mm/s as thousandths
of rad/s."""
POLL_S = 0.02


def arrived(here: Pose, target: Pose) -> bool:
    """Whether `here` is at `target`, within `ARRIVED_MM` and `ARRIVED_DEG`."""
    off_mm, off_deg = distance(here, target)
    return off_mm <= ARRIVED_MM and off_deg <= ARRIVED_DEG


async def until_settled(
    look: Callable[[], Awaitable[tuple[bool, Pose]]], target: Pose, planned_s: float, *, patient: bool = False
) -> None:
    """Return once `look`, which tells whether the arm rests and where its tip is, reports that it rests at `target`.

    Raises `MotionFailed` if the arm rests elsewhere, or if twice the planned time has passed and it comes no nearer: an
    arm whose speed was turned down on the pendant is slow, not stuck. If `patient`, an answer that cannot be read is an
    error only after twice the planned time: until then `look` asks again.
    """
    loop = asyncio.get_running_loop()
    begun_at, allowed_s = loop.time(), 2.0 * planned_s + 3.0
    idle_since: float | None = None
    nearest, nearer_at = math.inf, begun_at
    while True:
        late = loop.time() > begun_at + allowed_s
        try:
            steady, here = await look()
        except DeviceError as error:
            if late or not patient or isinstance(error, MotionError):
                raise
            await asyncio.sleep(POLL_S)
            continue
        now = loop.time()
        off_mm, off_deg = distance(here, target)
        if off_mm + off_deg < nearest - PROGRESS:
            nearest, nearer_at = off_mm + off_deg, now
        if steady and arrived(here, target):
            return
        idle_since = (idle_since or now) if steady else None
        if idle_since is not None and now - idle_since > RESTS_ELSEWHERE_S:
            raise _not_arrived(f"the arm rests {off_mm:.2f} mm and {off_deg:.2f} deg from the target")
        if late and now - nearer_at > STUCK_S:
            raise _not_arrived(f"still {off_mm:.2f} mm and {off_deg:.2f} deg from the target after {allowed_s:.1f} s")
        await asyncio.sleep(POLL_S)


def _not_arrived(what: str) -> MotionFailed:
    return MotionFailed(
        DEVICE,
        "moveLine",
        what,
        remedy="Look at the pendant for a message, and for another client that stops the arm. "
        "`brushloop collect plan --ask` tells whether a pose is out of reach.",
    )


MOST_QUEUED = 16
"""Lines that the controller holds at a time. The queue of a real cabinet is not documented; see `QUEUE_FULL` below."""
EMPTY = (-1, 0)
BLEND_MM = 1.0
"""How far before the end of a line that is fed the next one may begin, so that the arm does not halt there. ARCS takes
0, which halts, or 1 mm to 1 m."""


def as_sent(start: Pose, lines: Sequence[QueuedLine], limits: Limits) -> list[QueuedLine]:
    """The lines, each slow enough for its turn of the tool."""
    sent: list[QueuedLine] = []
    for line in lines:
        sent.append(replace(line, speed_mm_s=limits.turn_capped(start, line.target, line.speed_mm_s)))
        start = line.target
    return sent


def durations_s(start: Pose, lines: Sequence[QueuedLine], acc_mm_s2: float) -> list[float]:
    """Seconds of each of the lines from rest to rest, with a trapezoidal speed, or a triangular one if it is short."""
    estimates_s: list[float] = []
    for line in lines:
        travel_mm, turn_deg = distance(start, line.target)
        way, speed, acc = travel_mm, line.speed_mm_s, acc_mm_s2
        if travel_mm < IN_PLACE_MM and turn_deg > IN_PLACE_DEG:
            way, speed, acc = math.radians(turn_deg), speed / 1e3, acc / 1e3
        moving_s = way / speed + speed / acc if way * acc >= speed * speed else 2.0 * math.sqrt(way / acc)
        estimates_s.append(max(moving_s, line.least_s))
        start = line.target
    return estimates_s


async def feed(
    controller: Controller,
    start: Pose,
    lines: Sequence[QueuedLine],
    acc_mm_s2: float,
    *,
    go: Callable[[], None],
    notice: Callable[[str], None],
) -> None:
    """Queue every line from `start` on, at most `MOST_QUEUED` at a time; return once the last one is queued.

    Corners between them are rounded within `BLEND_MM`; at the last pose the arm halts.
    `go` raises if the arm was stopped: it is asked before every line, with nothing awaited between, because after a
    stop none may follow. Raises `RobotNotSafe`, `MotionRefused`, and `MotionFailed` where the arm was stopped meanwhile
    or does not advance.
    """
    loop = asyncio.get_running_loop()
    longest_s = max(durations_s(start, lines, acc_mm_s2))
    room, sent = MOST_QUEUED, 0
    queue, advanced_at = EMPTY, loop.time()

    await controller.require_safe("moveLine")
    while True:
        while sent < len(lines) and room > 0:
            go()
            line, blend_mm = lines[sent], BLEND_MM if sent + 1 < len(lines) else 0.0
            try:
                await controller.move_line(line.target, line.speed_mm_s, acc_mm_s2, blend_mm)
            except MotionRefused as refusal:
                if refusal.code != ReturnCode.QUEUE_FULL or sent == 0:  # then none of those in the queue is ours
                    raise
                break  # the controller holds fewer lines than assumed: it is sent again
            sent, room = sent + 1, room - 1
        if sent == len(lines):
            return
        await asyncio.sleep(POLL_S)
        go()
        await controller.require_safe("moveLine")
        before, queue, now = queue, await controller.queue(), loop.time()
        if queue != before:
            advanced_at = now
        elif now - advanced_at > STUCK_S + 2.0 * longest_s:
            what = f"the arm does not advance, after {sent} of {len(lines)} points were sent"
            raise MotionFailed(DEVICE, "follow", what)
        room = max(MOST_QUEUED - queue[1], 0)
        if queue == EMPTY:
            # The lines came too late; or the arm has not begun, or another client stopped it: then nothing may follow.
            if arrived(await controller.pose(), lines[sent - 1].target):
                notice(f"the arm halted at point {sent} of {len(lines)}: lines did not reach the controller in time")
            else:
                room = 0


async def queue_all(
    controller: Controller,
    start: Pose,
    lines: Sequence[QueuedLine],
    acc_mm_s2: float,
    *,
    go: Callable[[], None],
) -> None:
    """Queue every line on an arm that rests at `start`, then release it; return once it may have begun.

    `go` as for `feed`. Raises `RobotNotSafe`, `MotionRefused`, and `MotionFailed` where the arm was stopped meanwhile,
    or where the controller does not hold all lines, and `PathDisturbed` where it holds more: then the arm is not
    released.
    """
    await controller.require_safe("moveLine")
    go()
    await controller.hold_path()
    for line in lines:
        go()
        await controller.move_line(line.target, line.speed_mm_s, acc_mm_s2, least_s=line.least_s)
    rests = arrived(await controller.pose(), start)
    _, size = await controller.queue()  # last: what another client sends after this answer comes after our lift
    if size > len(lines):
        raise PathDisturbed(DEVICE, "sequence", f"the controller holds {size} lines, but {len(lines)} were sent")
    if size < len(lines):
        raise _not_begun(f"the controller holds {size} of {len(lines)} lines of the path")
    if not rests:
        raise _not_begun("the controller does not hold its path: the arm moved before its path was released")
    go()
    # Without a readable answer the arm may have begun, and a stop would leave the brush down: what it does will tell.
    with contextlib.suppress(ConnectionLost, DeviceTimeout, ProtocolViolation):
        await controller.go_on()


PATH_MM, PATH_DEG = 0.5, 0.5
"""Largest distance of the tip from its path: larger than the error of an arm that follows a slow straight line, smaller
than any drag that a mark would show."""


class OwnPath:
    """Watches the controller carry out our lines, from their release on, for anything that another client does."""

    def __init__(self, controller: Controller, start: Pose, lines: Sequence[QueuedLine], seen: Sequence[Pose]) -> None:
        """`seen` grows meanwhile by the poses that telemetry receives."""
        self._controller = controller
        self._corners = [start, *(line.target for line in lines)]
        self._seen = seen
        self._judged = 0
        self._begun = False
        self._most = self._lines = len(lines)
        self._ids: set[int] = set()

    async def look(self) -> tuple[bool, Pose]:
        """Whether the arm rests, and where. Raises `RobotNotSafe` and `PathDisturbed`.

        Any other error says nothing about the arm, which carries out all lines by itself.
        """
        self.require_followed()
        if self._controller.lost:
            await self._controller.open()
        running, size = await self._controller.queue()
        steady, here = await self._controller.rest()
        self._require_ours(running, size)
        self._require_near(here)
        return steady, here

    def require_followed(self) -> None:
        """Raise `PathDisturbed` if telemetry has shown the tip beside the path since it was first seen on it."""
        for pose in self._seen[self._judged :]:
            self._judged += 1
            if self._begun:
                self._require_near(pose)
            else:  # poses of an earlier move may still arrive
                self._begun = self._off(pose) is None

    def _require_ours(self, running: int, size: int) -> None:
        """The queue only shrinks, and every line but the running one of those seen so far has left it."""
        if running >= 0:
            self._ids.add(running)
        self._most = min(self._most, self._lines - max(len(self._ids) - 1, 0))
        if size > self._most:
            what = f"the controller holds {size} lines, but at most {self._most} of those sent can be left"
            raise PathDisturbed(DEVICE, "sequence", what)
        self._most = size

    def _require_near(self, pose: Pose) -> None:
        if (off := self._off(pose)) is not None:
            what = f"the tip was {off[0]:.2f} mm and {off[1]:.2f} deg from its path"
            raise PathDisturbed(DEVICE, "sequence", what)

    def _off(self, pose: Pose) -> tuple[float, float] | None:
        """How far a pose lies from the path, in mm and deg; None if it lies on it."""
        off_mm, off_deg = min((from_line(a, b, pose) for a, b in itertools.pairwise(self._corners)), key=sum)
        return None if off_mm <= PATH_MM and off_deg <= PATH_DEG else (off_mm, off_deg)


def _not_begun(why: str) -> MotionFailed:
    return MotionFailed(
        DEVICE,
        "sequence",
        f"{why}; the brush must not go down before its lift is queued",
        remedy="Close other clients of the controller. See docs/decisions.md.",
    )
