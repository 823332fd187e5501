"""The Aubo-i5 behind ARCS as a `Robot`: three sockets, so that neither stop nor telemetry waits for anything."""

from __future__ import annotations

import asyncio
import contextlib
import statistics
from collections.abc import Callable
from dataclasses import dataclass

from drivers.arcs.codes import LOOPBACK_CONTROL_BOX, RobotMode
from drivers.arcs.controller import Controller
from drivers.arcs.rpc import DEVICE, RpcConnection
from drivers.arcs.waiting import Tolerance, planned_s, until_mode, until_settled
from drivers.clock import Clock
from drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    NotConnected,
    ProtocolViolation,
    RpcError,
    Stale,
    WrongGeneration,
)
from drivers.limits import Limits
from drivers.samples import Identity, Pose, PoseSample, Stamp

AUBOPE_PORT = 8899


@dataclass(frozen=True, slots=True)
class ArcsOptions:
    """Where the controller is and how the arm is set up."""

    host: str
    port: int = 30004
    tcp_offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Flange to brush tip."""
    position_tolerance_mm: float = 0.05
    rotation_tolerance_deg: float = 0.1
    poll_s: float = 0.02
    telemetry_hz: float = 100.0
    stale_after_ms: float = 500.0
    power_timeout_s: float = 60.0
    stop_acc_m_s2: float = 2.0


@dataclass(frozen=True, slots=True)
class Condition:
    """The controller's words for robot mode and safety mode, and the median time of a call."""

    mode: str
    safety: str
    latency_ms: float


class AuboArcs:
    """`Robot` for an Aubo arm under ARCS. FK and IK are the controller's; units on the wire are m, rad, s."""

    def __init__(self, options: ArcsOptions, limits: Limits, clock: Clock) -> None:
        self._options = options
        self._limits = limits
        self._clock = clock
        self._motion, self._state, self._stop = (
            Controller(RpcConnection(options.host, options.port)) for _ in range(3)
        )
        self._reopening = asyncio.Lock()
        self._connected = False
        self._enabled = False
        self._latest: PoseSample | None = None
        self._listener: Callable[[PoseSample], None] | None = None
        self._telemetry: asyncio.Task[None] | None = None

    async def connect(self) -> Identity:
        """Connect and identify; telemetry runs from here on. Raises `WrongGeneration` for AUBOPE cabinets.

        After a failure nothing is left open, and an arm that was not identified has been told nothing.
        """
        try:
            return await self._connect()
        except BaseException:
            await self._hang_up()
            raise

    async def _connect(self) -> Identity:
        try:
            await self._state.connection.open()
        except (ConnectionLost, DeviceTimeout):
            if await self._answers(AUBOPE_PORT):
                raise WrongGeneration(
                    DEVICE,
                    "connect",
                    f"port {self._options.port} does not answer but {AUBOPE_PORT} does: this cabinet runs AUBOPE (V4)",
                    remedy="It needs the ARCS software; ask the maker for the upgrade.",
                ) from None
            raise
        version = await self._state.connection.call("SystemInfo.getInterfaceVersionCode")
        await self._state.connection.login()
        for controller in (self._stop, self._motion):
            await controller.connection.open()
            await controller.connection.login()
        [name, *_] = await self._state.robot_names()
        self._motion.robot = self._state.robot = self._stop.robot = name
        self._connected = True
        model = str(await self._state.ask("RobotConfig.getRobotType"))
        box = str(await self._state.ask("RobotConfig.getControlBoxType"))
        await self._read_pose()
        self._telemetry = asyncio.create_task(self._poll(), name="robot telemetry")
        return Identity(DEVICE, f"{model} ({box})", f"interface {version}", box == LOOPBACK_CONTROL_BOX)

    async def enable(self) -> None:
        """Set the tool offset, power on, release the brakes; moves nothing. Raises `RobotNotSafe`, `DeviceTimeout`."""
        self._enabled = True
        await self._motion.set_tcp_offset(self._options.tcp_offset_mm)
        await self._motion.require_safe("power on")
        if await self._motion.mode() != RobotMode.RUNNING:
            await self._motion.ask("RobotManage.poweron")
            await self._until_mode({RobotMode.IDLE, RobotMode.RUNNING})
            await self._motion.ask("RobotManage.startup")
            await self._until_mode({RobotMode.RUNNING})
        await self._read_pose()

    async def condition(self, calls: int) -> Condition:
        """What the controller says of the arm now; asks only. `calls` of one kind are timed, one after the other."""
        loop = asyncio.get_running_loop()
        took_s: list[float] = []
        for _ in range(calls):
            began = loop.time()
            await self._motion.pose()
            took_s.append(loop.time() - began)
        safety = str(await self._motion.ask("RobotState.getSafetyModeType"))
        return Condition(str(await self._motion.mode()), safety, statistics.median(took_s) * 1e3)

    def check(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Pure: raises `LimitExceeded`, asks nothing of the controller."""
        self._limits.check(DEVICE, target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)

    async def move(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """moveLine, then wait until the queue is empty, the arm steady and the pose within tolerance.

        Any failure, cancellation included, stops the arm before it is passed on.
        """
        self.check(target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)
        await self._restore_stop()
        options = self._options
        expected_s = planned_s(await self._motion.pose(), target, speed_mm_s, acc_mm_s2)
        try:
            await self._motion.move_line(target, speed_mm_s, acc_mm_s2)
            await until_settled(
                self._motion,
                target,
                Tolerance(options.position_tolerance_mm, options.rotation_tolerance_deg),
                planned_s=expected_s,
                poll_s=options.poll_s,
            )
        except BaseException as error:
            try:
                await asyncio.shield(self.stop())
            except DeviceError as failure:
                error.add_note(f"The arm may still be moving; stopping it failed too: {failure}")
            raise

    async def stop(self) -> None:
        """Decelerate along the path, then drop whatever is queued; on its own socket, opened again if it was lost."""
        if not self._connected:
            raise NotConnected(DEVICE, "stop", "not connected")
        try:
            await self._stop.halt(self._options.stop_acc_m_s2)
        except ConnectionLost:
            await self._restore_stop()
            await self._stop.halt(self._options.stop_acc_m_s2)

    def latest(self) -> PoseSample:
        """The newest pose. Raises `NotConnected` before the first, `Stale` after `stale_after_ms`."""
        if self._latest is None:
            raise NotConnected(DEVICE, "latest", "no pose yet")
        age_ms = (self._clock.now_ns() - self._latest.stamp.host_ns) / 1e6
        if age_ms > self._options.stale_after_ms:
            raise Stale(DEVICE, age_ms, self._options.stale_after_ms)
        return self._latest

    def listen(self, on_sample: Callable[[PoseSample], None] | None) -> None:
        """Hand every telemetry sample to `on_sample` in the event loop."""
        self._listener = on_sample

    async def close(self) -> None:
        """Stop, end telemetry, close all sockets in reverse order of opening.

        An arm that was never enabled from here is not stopped: it may be somebody else's motion.
        """
        self._listener = None
        try:
            if self._enabled:
                with contextlib.suppress(DeviceError):
                    await self.stop()
        finally:
            await self._hang_up()

    async def _hang_up(self) -> None:
        if self._telemetry is not None:
            self._telemetry.cancel()
            await asyncio.gather(self._telemetry, return_exceptions=True)
            self._telemetry = None
        for controller in (self._motion, self._stop, self._state):
            await controller.connection.close()
        self._connected = self._enabled = False

    async def _until_mode(self, wanted: set[RobotMode]) -> None:
        options = self._options
        await until_mode(self._motion, wanted, timeout_s=options.power_timeout_s, poll_s=options.poll_s)

    async def _restore_stop(self) -> None:
        """No motion without a way to stop it: a controller may have dropped the idle connection."""
        async with self._reopening:
            if self._stop.connection.lost:
                await self._stop.connection.reopen()

    async def _poll(self) -> None:
        loop = asyncio.get_running_loop()
        period_s = 1.0 / self._options.telemetry_hz
        due = loop.time()
        while True:
            # A gap shows as an old sample (`Stale`); the motion path reports the cause.
            with contextlib.suppress(DeviceTimeout, ConnectionLost, ProtocolViolation, RpcError):
                await self._read_pose()
            due = max(due + period_s, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _read_pose(self) -> None:
        pose = await self._state.pose()
        seq = self._latest.stamp.seq + 1 if self._latest else 0
        self._latest = PoseSample(Stamp(self._clock.now_ns(), None, seq), pose)
        if self._listener is not None:
            self._listener(self._latest)

    async def _answers(self, port: int) -> bool:
        probe = RpcConnection(self._options.host, port)
        try:
            await probe.open()
        except DeviceError:
            return False
        await probe.close()
        return True
