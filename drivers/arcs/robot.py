"""The Aubo-i5 behind ARCS: three sockets, so that neither stop nor telemetry waits for anything.

Any client of the controller may use the arm and change its settings, so place and settings are checked before each
motion: an arm that is not where it was left, or is not set up as it was, is not sent anywhere.
"""

import asyncio
import contextlib
import itertools
from collections.abc import AsyncGenerator, Callable, Sequence

from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, Controller, RobotMode
from brushloop.drivers.arcs.motion import POLL_S, OwnPath, arrived, as_sent, durations_s, feed, queue_all, until_settled
from brushloop.drivers.arcs.settings import ArcsTable, Settings, make_ready, power_on, read_back
from brushloop.drivers.arcs.stopping import Stopper
from brushloop.drivers.arcs.telemetry import Telemetry
from brushloop.drivers.arcs.wire import DEVICE, open_arcs
from brushloop.drivers.devices import Identity, Pose, PoseSample, QueuedLine
from brushloop.drivers.errors import ArmMoved, DeviceError, MotionFailed, NotConnected, NotPowered
from brushloop.drivers.geometry import distance
from brushloop.drivers.host import Clock, finished
from brushloop.drivers.limits import Limits

STOP_ACC_M_S2 = 2.0
MOVED_MM, MOVED_DEG = 0.5, 0.5
"""Limits beyond which another client or a person moved the arm: larger than the tolerance of any settled move."""
DOWN_MM = 0.01
"""A line that ends more than this lower counts as going down."""
RESTS_S = 0.5
"""Longest wait for rest: an arm that has just settled may take a moment to report it."""


class AuboArcs:
    """An Aubo arm under ARCS, with a brush: all poses are of the brush tip, in the base frame.

    FK and IK are the controller's; units on the wire are m, rad, s.
    """

    def __init__(self, table: ArcsTable, limits: Limits, clock: Clock, on_notice: Callable[[str], None]) -> None:
        self._table = table
        self._limits = limits
        self._notice = on_notice
        self._motion, self._state, self._stop = (
            Controller(table.host, table.port, framing=table.framing) for _ in range(3)
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
        self._settings: Settings | None = None
        """As read back when the arm was enabled."""
        self._left: Pose | None = None
        """Where the last line ended, or where `take_up` found the arm; None after a line that did not reach its end."""
        self._motion.on_pose = self._telemetry.lag.asked

    async def connect(self) -> Identity:
        """Connect and identify; sets and powers nothing, telemetry runs from here on. Raises `DeviceError`."""
        await open_arcs(self._state)
        version = await self._state.call("SystemInfo.getInterfaceVersionCode")
        for controller in (self._stop, self._motion):
            await controller.open()
        self._motion.robot = self._state.robot = self._stop.robot = await self._state.first_robot()
        self._connected = True
        model = str(await self._state.ask("RobotConfig.getRobotType"))
        box = str(await self._state.ask("RobotConfig.getControlBoxType"))
        await self._telemetry.start()
        firmware = f"interface {version}"
        if self._table.rtde_port is not None:
            firmware += f", telemetry by {self._telemetry.source}"
        return Identity(f"{model} ({box})", firmware, box == LOOPBACK_CONTROL_BOX)

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
        self._left, self._settings = await self._motion.pose(), settings
        await self._telemetry.read()

    async def modes(self) -> tuple[str, str]:
        """The controller's names of its robot mode and its safety mode."""
        return await self._motion.mode(), await self._motion.safety()

    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Send lines through all poses without a halt between them; returns when the arm has settled at the last.

        Corners may be rounded within 1 mm of a pose. Every pose, and every line from where the arm really is, is
        checked before the first line is sent. Any failure, cancellation included, stops the arm before it is raised.
        Raises `ArmMoved` if the arm is not where it was left, `SettingsChanged` before a line down if what a press
        depends on is not as it was set, `RobotNotSafe`, `NotPowered`, `LimitExceeded`, and ValueError for no poses.
        """
        if not poses:
            raise ValueError("follow: no poses")
        lines = [QueuedLine(pose, speed_mm_s) for pose in poses]
        start = await self._depart("moveLine", lines, acc_mm_s2)
        lines = as_sent(start, lines, self._limits)
        async with self._under_way("moveLine", poses[-1]) as go:
            await feed(self._motion, start, lines, acc_mm_s2, go=go, notice=self._notice)
            await until_settled(self._motion.rest, poses[-1], sum(durations_s(start, lines, acc_mm_s2)))

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        """Queue all lines while the controller holds its path, release it, and wait as `follow` does; return the poses
        seen meanwhile.

        After the release the lines are carried out to the end even if this program dies, and answers that cannot be
        read do not stop the arm; a stop drops all lines. Raises as `follow` does, `PathDisturbed` if another client
        interferes, and ValueError for no lines and for lines that end where the arm is.
        """
        start = await self._depart("sequence", lines, acc_mm_s2)
        if not lines or arrived(start, end := lines[-1].target):
            raise ValueError("sequence: it must not end where it begins")
        lines = as_sent(start, lines, self._limits)
        async with self._under_way("sequence", end) as go:
            self._held = True
            with self._telemetry.seeing() as seen:
                path = OwnPath(self._motion, start, lines, seen)
                await queue_all(self._motion, start, lines, acc_mm_s2, go=go)
                await until_settled(path.look, end, sum(durations_s(start, lines, acc_mm_s2)), patient=True)
                self._held = False
                await self._telemetry.reaching(end)
                path.require_followed()
            return seen

    @contextlib.asynccontextmanager
    async def _under_way(self, op: str, target: Pose) -> AsyncGenerator[Callable[[], None]]:
        """Whatever ends the block before the arm has settled at `target`, the arm is stopped before it is raised.

        Yields a function that raises `MotionFailed` if the arm was stopped since the block began.
        """
        stops, self._left = self._stops, None
        try:
            yield lambda: self._require_no_stop_since(stops, op)
        except BaseException as error:
            try:
                await finished(self.stop())
            except DeviceError as failure:
                error.add_note(str(failure))
            raise
        self._left = target

    def _require_no_stop_since(self, stops: int, op: str) -> None:
        if self._stops != stops:
            raise MotionFailed(DEVICE, op, "the arm was stopped")

    async def _depart(self, op: str, lines: Sequence[QueuedLine], acc_mm_s2: float) -> Pose:
        """Return where the arm is, once it may go from there along `lines`."""
        for line in lines:
            self._limits.check(DEVICE, line.target, speed_mm_s=line.speed_mm_s, acc_mm_s2=acc_mm_s2)
        self._require_enabled(op)
        stops = self._stops
        await self._ready()
        start = await self._resting(op)
        ways = list(itertools.pairwise([start, *(line.target for line in lines)]))
        if self._moved(start) or any(b.z_mm < a.z_mm - DOWN_MM for a, b in ways):
            await self._require_settings(op)  # with another tool, the same place would look like another
        self._require_place(op, start)
        for a, b in ways:
            self._limits.check_way(DEVICE, a, b)
        self._require_no_stop_since(stops, op)
        return start

    async def confirm(self) -> None:
        """Raise `RobotNotSafe`, `NotPowered`, `SettingsChanged` or `ArmMoved` if the arm is not as it was left."""
        await self._require_settings("confirm")
        self._require_place("confirm", await self._resting("confirm"))

    async def take_up(self) -> Pose:
        """Accept the place where the arm rests as the start of the next line.

        Raises `ArmMoved` while it moves, `SettingsChanged` if a pose would refer to another tool, `RobotNotSafe`,
        `NotPowered`.
        """
        here = await self._resting("take up")
        await self._require_settings("take up")
        self._left = here
        return here

    def _require_enabled(self, op: str) -> Settings:
        if self._settings is None:
            raise NotConnected(DEVICE, op, "not enabled")
        return self._settings

    async def _require_settings(self, op: str) -> None:
        settings, current = self._require_enabled(op), await read_back(self._motion)
        await self._motion.require_safe(op)
        if await self._motion.mode() != RobotMode.RUNNING:
            raise NotPowered(DEVICE, op)
        current.require(op, settings)

    async def _resting(self, op: str) -> Pose:
        """Where the arm rests. Raises `ArmMoved` if it moves, `RobotNotSafe` if a safety stop holds its path."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + RESTS_S
        while not await self._motion.at_rest():
            if loop.time() > until_s:
                await self._motion.require_safe(op)
                raise ArmMoved(DEVICE, op, *self._off(await self._motion.pose()), moving=True)
            await asyncio.sleep(POLL_S)
        return await self._motion.pose()

    def _require_place(self, op: str, here: Pose) -> None:
        if self._moved(here):
            raise ArmMoved(DEVICE, op, *self._off(here))

    def _moved(self, here: Pose) -> bool:
        off_mm, off_deg = self._off(here)
        return off_mm > MOVED_MM or off_deg > MOVED_DEG

    def _off(self, here: Pose) -> tuple[float, float]:
        return (0.0, 0.0) if self._left is None else distance(self._left, here)

    async def stop(self) -> None:
        """Decelerate along the path, drop whatever is queued, and return once the arm is seen at rest.

        Idempotent, from any state, never queued behind a slow call. Raises `MotionFailed` if the arm is not seen at
        rest: then only the emergency stop is left.
        """
        if not self._connected:
            raise NotConnected(DEVICE, "stop", "not connected")
        self._stops += 1
        await self._stopper.stop(STOP_ACC_M_S2)

    async def where(self) -> Pose:
        """Ask the controller for the pose, independently of telemetry."""
        return await self._motion.pose()

    def latest(self) -> PoseSample:
        """The newest pose; never blocks. Raises `NotConnected` before the first, `Stale` when it is too old."""
        return self._telemetry.latest()

    def pose_lag_ms(self) -> float | None:
        """How late poses arrived during the last motions, measured against `where`; None if that is not known."""
        return self._telemetry.lag.lag_ms()

    def listen(self, on_sample: Callable[[PoseSample], None] | None) -> None:
        """Hand every telemetry sample to `on_sample`, in the event loop; None ends it."""
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
                under_way = self._settings is not None and self._left is None
                try:
                    await self.stop()
                except DeviceError:
                    if under_way:
                        raise
        finally:
            await self._telemetry.stop()
            for controller in (self._motion, self._stop, self._state):
                await controller.close()
            self._connected = self._enabled = False
            self._settings = None

    async def _ready(self) -> None:
        """Before each motion, make sure that it can be stopped and that the controller does not hold its path."""
        await self._restore_stop()
        if self._held and await self._motion.idle():
            await self._motion.release()
            self._held = False

    async def _restore_stop(self) -> None:
        """Reopen the stop connection if it is lost: the controller may have dropped it while idle."""
        async with self._reopening:
            if self._stop.lost:
                await self._stop.open()
