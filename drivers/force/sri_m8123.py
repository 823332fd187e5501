"""A six-axis force sensor on a Sunrise SRI M8123B2 board, over python-can.

The frame format is from public third-party code, not from the maker's manual; no board has confirmed it yet.
The sensor needs a CAN adapter and a bus of its own: the arm's internal bus is never touched.
"""

from __future__ import annotations

import asyncio
import contextlib
import statistics
from collections.abc import Callable

from brushloop.drivers.clock import Clock
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    Stale,
    Stuck,
    too_busy,
)
from brushloop.drivers.force.rounds import Wrench
from brushloop.drivers.force.stream import ForceHealth, RoundStream, SriOptions
from brushloop.drivers.samples import ForceSample, Identity, Stamp

DEVICE = "force"
AXES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
MIN_BIAS_ROUNDS = 10
MIN_ALIKE_ROUNDS = 10
"""Fewer rounds may be equal by chance, on a sensor that is slow or coarse."""
MAX_BIAS_S = 60.0
MORE_BIAS_S = 1.0
"""Extra averaging time if too few rounds arrived."""
NO_BIAS: Wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class SriM8123:
    """`ForceSensor` over a `RoundStream`; samples reach listeners in the event loop that connected."""

    def __init__(self, options: SriOptions, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._stream: RoundStream | None = None
        self._listener: Callable[[ForceSample], None] | None = None
        self._biasing = asyncio.Lock()
        self.bias_wrench = NO_BIAS
        """What is subtracted from every round; raw value = sample + bias."""

    async def connect(self) -> Identity:
        """Open the bus, start the board, wait for its first complete round. Raises `ConnectionLost`, `DeviceTimeout`.

        After a failure the board is stopped and nothing is left open. A bias does not survive.
        """
        await self.close()
        options = self._options
        loop, begun = asyncio.get_running_loop(), asyncio.Event()
        self.bias_wrench = NO_BIAS

        def on_round(stamp: Stamp, wrench: Wrench) -> None:
            if not begun.is_set() or self._listener is not None:
                in_loop(lambda: deliver(stamp, wrench))

        def in_loop(call: Callable[[], object]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop ended before the stream was closed
                loop.call_soon_threadsafe(call)

        def deliver(stamp: Stamp, wrench: Wrench) -> None:
            begun.set()
            if self._stream is stream and self._listener is not None:
                self._listener(self._sample(stamp, wrench))

        stream = RoundStream(
            options,
            self._clock,
            on_round=on_round,
            on_loss=lambda: in_loop(begun.set),
        )
        self._stream = stream
        stream.start()
        try:
            async with asyncio.timeout(options.connect_timeout_s):
                await begun.wait()
            self._require("connect")
        except TimeoutError:
            health = stream.health()
            await self.close()
            raise DeviceTimeout(
                DEVICE,
                "connect",
                f"no whole round in {options.connect_timeout_s:g} s ({health.torn} torn, {health.refused} refused)",
                remedy="Check power, wiring, termination and bit rate.",
            ) from None
        except BaseException:
            await self.close()
            raise
        # The board has no identification. No real board can be on a virtual bus or on the loopback rig's bus.
        return Identity(DEVICE, f"SRI M8123B2 on {stream.channel_info}", "", stream.virtual)

    def latest_n(self) -> tuple[float, float, float]:
        """The newest force in N, less the bias; never blocks. Raises what `latest` raises."""
        return self.latest().force_n

    def latest(self) -> ForceSample:
        """The newest sample; never blocks. Raises `Stale`, `Stuck`, `ConnectionLost`, `NotConnected`."""
        stream = self._require("latest")
        newest, alike = stream.newest, stream.alike
        if newest is None:
            raise NotConnected(DEVICE, "latest", "no sample yet")
        age_ms = (self._clock.now_ns() - newest[0].host_ns) / 1e6
        if age_ms > self._options.stale_after_ms:
            raise Stale(DEVICE, age_ms, self._options.stale_after_ms)
        alike_ms = (newest[0].host_ns - stream.alike_since_ns) / 1e6
        if alike >= MIN_ALIKE_ROUNDS and alike_ms > self._options.stuck_after_ms:
            raise Stuck(DEVICE, alike_ms, alike)
        return self._sample(*newest)

    def listen(self, on_sample: Callable[[ForceSample], None] | None) -> None:
        """Hand every sample to `on_sample`, in the event loop; None ends it."""
        self._listener = on_sample

    async def bias(self, seconds: float) -> None:
        """Average for `seconds` with nothing touching, and subtract that from now on.

        Raises `DeviceError` if the sensor was not still, `Stale` or `DeviceTimeout` if it sent too little,
        `LimitExceeded` for a time not in (0, 60] s; the previous bias then remains.
        """
        if not 0.0 < seconds <= MAX_BIAS_S:
            raise LimitExceeded(DEVICE, "bias time", seconds, 0.0, MAX_BIAS_S, "s")
        async with self._biasing:
            stream = self._require("bias")
            rounds: list[Wrench] = []
            stream.collecting = rounds
            try:
                await asyncio.sleep(seconds)
                if len(rounds) < MIN_BIAS_ROUNDS:  # a busy computer: too few to judge stillness
                    await asyncio.sleep(MORE_BIAS_S)
            finally:
                stream.collecting = None
            if self._stream is not stream:
                raise NotConnected(DEVICE, "bias", "closed while averaging")
            self.latest()
            if len(rounds) < MIN_BIAS_ROUNDS:
                what = f"{len(rounds)} rounds in {seconds + MORE_BIAS_S:g} s, {MIN_BIAS_ROUNDS} are needed"
                raise DeviceTimeout(DEVICE, "bias", what, remedy="Average for longer.")
            axes = zip(*rounds, strict=True)
            fx, fy, fz, mx, my, mz = (self._still_mean(name, axis) for name, axis in zip(AXES, axes, strict=True))
            self.bias_wrench = (fx, fy, fz, mx, my, mz)

    def health(self) -> ForceHealth:
        """Measured rate and counters since `connect`. Raises `NotConnected`; a lost connection still has them."""
        if self._stream is None:
            raise NotConnected(DEVICE, "health", "not connected")
        return self._stream.health()

    async def close(self) -> None:
        """Stop the board, shut the bus down, join the reader; may be repeated."""
        stream, self._stream = self._stream, None
        if stream is not None:
            await asyncio.shield(asyncio.to_thread(stream.stop))

    def _require(self, op: str) -> RoundStream:
        if self._stream is None:
            raise NotConnected(DEVICE, op, "not connected")
        if (loss := self._stream.loss) is not None:
            raise ConnectionLost(DEVICE, op, loss.what, remedy=f"{too_busy()} {loss.remedy}".strip())
        return self._stream

    def _sample(self, stamp: Stamp, wrench: Wrench) -> ForceSample:
        fx, fy, fz, mx, my, mz = (raw - bias for raw, bias in zip(wrench, self.bias_wrench, strict=True))
        return ForceSample(stamp, (fx, fy, fz), (mx, my, mz))

    def _still_mean(self, name: str, values: tuple[float, ...]) -> float:
        limit, unit = (self._options.still_n, "N") if name.startswith("F") else (self._options.still_nm, "Nm")
        deviation = statistics.stdev(values)
        if deviation > limit:
            raise DeviceError(
                DEVICE,
                "bias",
                f"{name} varied by {deviation:.4f} {unit} (standard deviation), limit {limit:g} {unit}",
                condition="The previous bias remains.",
                remedy="Let nothing touch the brush, wait until the arm is still, and try again.",
            )
        return statistics.fmean(values)
