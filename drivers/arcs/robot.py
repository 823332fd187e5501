"""The Aubo-i5 behind ARCS as a `Robot`: three sockets, so that neither stop nor telemetry waits for anything."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Sequence

from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, Controller
from brushloop.drivers.arcs.motion import (
    Leg,
    OwnPath,
    arrived,
    feed,
    legs_of,
    queue_all,
    seconds_of,
    until_settled,
)
from brushloop.drivers.arcs.settings import ArcsTable, Departure, make_ready, power_on
from brushloop.drivers.arcs.stopping import Stopper
from brushloop.drivers.arcs.telemetry import Telemetry
from brushloop.drivers.arcs.wire import DEVICE, RpcConnection, open_arcs
from brushloop.drivers.devices import Identity, Pose, PoseSample, QueuedLine
from brushloop.drivers.errors import DeviceError, MotionFailed, NotConnected
from brushloop.drivers.host import Clock, finished
from brushloop.drivers.limits import Limits

__all__ = ["ArcsTable", "AuboArcs"]

STOP_ACC_M_S2 = 2.0


class AuboArcs:
    """`Robot` for an Aubo arm under ARCS. FK and IK are the controller's; units on the wire are m, rad, s."""

    def __init__(
        self,
        table: ArcsTable,
        limits: Limits,
        clock: Clock,
        on_notice: Callable[[str], None] = lambda _text: None,
    ) -> None:
        self._table = table
        self._limits = limits
        self._notice = on_notice
        self._motion, self._state, self._stop = (
            Controller(RpcConnection(table.host, table.port, framing=table.framing)) for _ in range(3)
        )
        self._reopening = asyncio.Lock()
        self._stopper = Stopper([self._stop, self._state], self._motion, self._restore_stop)
        self._stops = 0
        """Number of stops so far; a motion compares it, because it must send no line after a stop."""
        self._held = False
        """Whether the controller may hold its path."""
        self._connected = False
        self._enabled = False
        self._telemetry = Telemetry(self._state, table, clock, on_notice)
        self._departure: Departure | None = None
        """Of the arm since it was enabled."""
        self._motion.on_pose = self._telemetry.lag.asked

    async def connect(self) -> Identity:
        """Connect and identify; telemetry runs from here on. Raises `WrongGeneration` for AUBOPE cabinets.

        After a failure nothing is left open, and nothing was set on an arm that was not identified.
        """
        try:
            await open_arcs(self._state.connection)
            version = await self._state.connection.call("SystemInfo.getInterfaceVersionCode")
            for controller in (self._stop, self._motion):
                await controller.connection.open()
            [name, *_] = await self._state.robot_names()
            self._motion.robot = self._state.robot = self._stop.robot = name
            self._connected = True
            model = str(await self._state.ask("RobotConfig.getRobotType"))
            box = str(await self._state.ask("RobotConfig.getControlBoxType"))
            await self._telemetry.start()
        except BaseException:
            await self._hang_up()
            raise
        firmware = f"interface {version}"
        if self._table.rtde_port is not None:
            firmware += f", telemetry by {self._telemetry.source}"
        return Identity(DEVICE, f"{model} ({box})", firmware, box == LOOPBACK_CONTROL_BOX)

    async def enable(self) -> None:
        """Check the mode, set the tool, power on, release the brakes; moves nothing.

        Raises `MotionError`, of which are `RobotNotSafe`, `MotionRefused` and `SettingsChanged`, and `DeviceTimeout`.
        """
        self._enabled = True
        if not await self._motion.idle():
            # A process that was killed may have left a line in the queue: stop it before anything is set or computed.
            try:
                await self.stop()
            except MotionFailed:
                await self._motion.require_safe("power on")  # a safety stop holds the path, and is the cause
                raise
        settings = await make_ready(self._motion, self._table)
        await power_on(self._motion)
        self._held = True  # a process that was killed may have left it so
        await self._ready()
        self._departure = Departure(self._motion, settings, await self._motion.pose())
        await self._telemetry.read()

    async def modes(self) -> tuple[str, str]:
        """The controller's names of its robot mode and its safety mode."""
        return await self._motion.mode(), await self._motion.safety()

    def check(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Raise `LimitExceeded` where the target is not allowed, without asking the controller."""
        self._limits.check(DEVICE, target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)

    async def move(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Send moveLine, then wait until the queue is empty, the arm steady and the pose within tolerance.

        The whole line is checked, from where the arm really is. Any failure, cancellation included, stops the arm
        before it is raised.
        """
        await self._feed([QueuedLine(target, speed_mm_s)], acc_mm_s2)

    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float, blend_mm: float) -> None:
        """Send lines through all poses without a halt between them, then wait as `move` does at the last.

        Every pose, and every line between two of them, is checked before the first line is sent. Raises ValueError for
        no poses.
        """
        if not poses:
            raise ValueError("follow: no poses")
        await self._feed([QueuedLine(pose, speed_mm_s) for pose in poses], acc_mm_s2, blend_mm)

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        """Queue all lines while the controller holds its path, release it, and wait as `move` does.

        After the release, answers that cannot be read do not stop the arm. Raises `PathDisturbed` if another client
        interferes, and ValueError for no lines and for lines that end where the arm is.
        """
        start = await self._depart("sequence", lines, acc_mm_s2)
        if not lines or arrived(start, lines[-1].target):
            raise ValueError("sequence: it must not end where it begins")
        legs = legs_of(start, lines, self._limits, acc_mm_s2)
        async with self._under_way(legs) as stopped:
            self._held = True
            with self._telemetry.seeing() as seen:
                path = OwnPath(self._motion, start, legs, seen)
                await queue_all(self._motion, start, legs, acc_mm_s2, stopped=stopped)
                await until_settled(path.look, legs[-1].target, seconds_of(legs), patient=True)
                self._held = False
                await self._telemetry.reaching(legs[-1].target)
                path.require_followed()
            return seen

    async def _feed(self, lines: Sequence[QueuedLine], acc_mm_s2: float, blend_mm: float | None = None) -> None:
        start = await self._depart("moveLine", lines, acc_mm_s2)
        legs = legs_of(start, lines, self._limits, acc_mm_s2, blend_mm)
        async with self._under_way(legs) as stopped:
            await feed(self._motion, legs, acc_mm_s2, stopped=stopped, notice=self._notice)
            await until_settled(self._motion.rest, legs[-1].target, seconds_of(legs))

    @contextlib.asynccontextmanager
    async def _under_way(self, legs: Sequence[Leg]) -> AsyncGenerator[Callable[[], bool]]:
        """Whatever ends the block before the arm has settled, the arm is stopped before it is raised.

        Yields a function that tells whether the arm was stopped since the block began.
        """
        departure, stops = self._require_enabled("moveLine"), self._stops
        departure.left = None
        try:
            yield lambda: self._stops != stops
        except BaseException as error:
            try:
                await finished(self.stop())
            except DeviceError as failure:
                error.add_note(str(failure))
            raise
        departure.left = legs[-1].target

    async def _depart(self, op: str, lines: Sequence[QueuedLine], acc_mm_s2: float) -> Pose:
        """Check that the arm may go along `lines` from where it is, and return that place; see `Departure`."""
        for line in lines:
            self.check(line.target, speed_mm_s=line.speed_mm_s, acc_mm_s2=acc_mm_s2)
        departure, stops = self._require_enabled(op), self._stops
        await self._ready()
        start = await departure.ready(op, self._limits, [line.target for line in lines])
        if self._stops != stops:
            raise MotionFailed(DEVICE, op, "the arm was stopped", condition="Nothing was sent to it.")
        return start

    async def stop(self) -> None:
        """Decelerate along the path, drop whatever is queued, and return once the arm is seen at rest.

        Raises `MotionFailed` if it is not: then only the emergency stop is left.
        """
        if not self._connected:
            raise NotConnected(DEVICE, "stop", "not connected")
        self._stops += 1
        await self._stopper.stop(STOP_ACC_M_S2)

    async def where(self) -> Pose:
        """Ask the controller for the pose, independently of telemetry."""
        return await self._motion.pose()

    async def confirm(self) -> None:
        """Raise `RobotNotSafe`, `NotPowered`, `SettingsChanged` or `ArmMoved` if the arm is not as it was left."""
        await self._require_enabled("confirm").confirm()

    async def take_up(self) -> Pose:
        """Accept the place where the arm rests as the start of the next move. Raises as `confirm` does."""
        return await self._require_enabled("take up").take_up()

    def _require_enabled(self, op: str) -> Departure:
        if self._departure is None:
            raise NotConnected(DEVICE, op, "not enabled")
        return self._departure

    def latest(self) -> PoseSample:
        """The newest pose. Raises `NotConnected` before the first, `Stale` after `stale_after_ms`."""
        return self._telemetry.latest()

    def pose_lag_ms(self) -> float | None:
        """How late poses arrived during the last motions, measured against `where`; None if that is not known."""
        return self._telemetry.lag.lag_ms()

    def listen(self, on_sample: Callable[[PoseSample], None] | None) -> None:
        """Hand every telemetry sample to `on_sample` in the event loop."""
        self._telemetry.listener = on_sample

    async def close(self) -> None:
        """Stop, end telemetry, close all sockets in reverse order of opening.

        An arm that was never enabled from here is not stopped: its motion may be another client's. A cancellation
        takes effect at the end. Raises `MotionFailed` if a line was under way and the arm is not seen at rest.
        """
        await finished(self._close())

    async def _close(self) -> None:
        self._telemetry.listener = None
        try:
            if self._enabled:
                under_way = self._departure is not None and self._departure.left is None
                try:
                    await self.stop()
                except DeviceError:
                    if under_way:
                        raise
        finally:
            await self._hang_up()

    async def _hang_up(self) -> None:
        await self._telemetry.stop()
        for controller in (self._motion, self._stop, self._state):
            await controller.connection.close()
        self._connected = self._enabled = False
        self._departure = None

    async def _ready(self) -> None:
        """Before each motion, make sure that it can be stopped and that the controller does not hold its path."""
        await self._restore_stop()
        if self._held and await self._motion.idle():
            await self._motion.release()
            self._held = False

    async def _restore_stop(self) -> None:
        """Reopen the stop connection if it is lost: the controller may have dropped it while idle."""
        async with self._reopening:
            if self._stop.connection.lost:
                await self._stop.connection.open()
