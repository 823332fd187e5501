"""A six-axis force sensor on a Sunrise SRI M8123B2 board, over python-can.

The frame format is from public third-party code, not from the maker's manual; no board has confirmed it yet: three
frames per round, two float32 each, low byte first; see docs/zero-touch.md.

The frames carry no counter: only their order and timing show which three belong together. The sensor needs a CAN
adapter and a bus of its own: the arm's internal bus is never touched. A thread owns the bus from open to shutdown and
turns its frames into wrenches.
"""

import asyncio
import contextlib
import logging
import statistics
import struct
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BaseModel, Field, model_validator

from brushloop.drivers.devices import ForceSample, Identity, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, NotConnected, Stale, Stuck, too_busy
from brushloop.drivers.host import Clock

if TYPE_CHECKING:
    import can

Wrench = tuple[float, ...]
"""Fx, Fy, Fz in N and Mx, My, Mz in Nm, in the sensor's frame."""

LOOPBACK_CHANNEL = "loopback-force-board"
"""The loopback rig's bus on a socketcand gateway. Longer than the 15 characters that a network interface's name may
have, so no gateway to a real bus can serve it."""

COMMAND_ID = 0x080
START = b"\x02"
STOP = b"\x00"
FIRST_ID = 0x291
BUS_OFF = 0x40
"""Bit of an error frame's id (Linux `can/error.h`): the controller took itself off the bus."""
_PAIR = struct.Struct("<2f")
ROUND_S = 0.005
"""Longest time from the first to the third frame of a round. It must be shorter than the sensor's period: otherwise two
rounds that each lost frames can pass for one."""
MEASURABLE: Wrench = (1000.0, 1000.0, 1000.0, 100.0, 100.0, 100.0)
"""Values beyond what the sensor can measure are refused like NaN."""


def encode_round(wrench: Wrench) -> tuple[tuple[int, bytes], ...]:
    """The three frames of a round, as (id, bytes)."""
    return tuple((FIRST_ID + place, _PAIR.pack(*wrench[2 * place : 2 * place + 2])) for place in range(3))


class RoundAssembler:
    """Turns frames into wrenches; incomplete and implausible rounds are dropped and counted."""

    def __init__(self) -> None:
        self._frames: list[bytes] = []
        """Of the present round, in their order."""
        self._began_s: float | None = None
        self._last_place = -1
        self.torn = 0
        self.refused = 0

    def feed(self, can_id: int, data: bytes, at_s: float) -> Wrench | None:
        """Take a frame received at `at_s`; return the wrench that it completes, else None."""
        place = can_id - FIRST_ID
        if not 0 <= place < 3 or (self._began_s is None and place > 0):  # joining in mid-round is not a fault
            return None
        late = self._began_s is None or not abs(at_s - self._began_s) <= ROUND_S
        if place <= self._last_place or late:  # a new round, even if its first frame was lost
            self.torn += bool(self._frames)
            self._frames, self._began_s = [], at_s
        self._frames.append(data)
        self._last_place = place
        if place < 2:
            return None
        frames, self._frames = self._frames, []
        if [len(frame) for frame in frames] != [_PAIR.size] * 3:
            self.torn += 1
            return None
        wrench = tuple(value for frame in frames for value in _PAIR.unpack(frame))
        # Written so that NaN fails the check.
        if not all(abs(value) <= limit for value, limit in zip(wrench, MEASURABLE, strict=True)):
            self.refused += 1
            return None
        return wrench


DEVICE = "force"
AXES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
CONNECT_S = 10.0
"""Time to open the bus, even through a gateway, and get a first round."""
RECEIVE_S = 0.05
JOIN_S = 5.0
"""Longest wait for the reader to stop the board."""
STUCK_MS, STUCK_ROUNDS = 100.0, 10
"""Rounds that are equal to the last bit in all six values, so many and for so long, mean a stuck sensor. Fewer may be
equal by chance, on a sensor that is slow or coarse."""
STILL_N, STILL_NM = 0.05, 0.01
"""The largest standard deviation, in each axis, at which the sensor counts as still."""
MIN_BIAS_ROUNDS = 10

MOST_STALE_MS = 100.0
"""Longest silence allowed: at 20 mm/s the brush goes down 2 mm in this time without being felt."""
MOST_STALE_LOOPBACK_MS = 2000.0
"""The same on the loopback rig's bus, where simulated time may run faster than the sensor's rounds arrive."""


class ForceTable(BaseModel, frozen=True, extra="forbid"):
    """The table `[force]` of `rig.toml`: a sensor between flange and brush (docs/zero-touch.md)."""

    kind: Literal["sri-m8123"]
    interface: str = Field("socketcan", min_length=1)
    """As python-can names it: socketcan, slcan, pcan, socketcand and so on."""
    channel: str = Field("can0", min_length=1)
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    host: str | None = None
    """Address of a CAN gateway, for the interface socketcand."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    max_n: Annotated[float, Field(gt=0.0, le=1e6)] = 5.0
    """Ceiling while the brush is down: above it the arm is stopped and the press is void."""
    stale_ms: Annotated[float, Field(ge=20.0)] = 100.0
    """While the brush goes down, silence of this length stops the arm; at most 100, except on the loopback bus."""
    bias_s: Annotated[float, Field(ge=0.05, le=60.0)] = 0.5
    """How long to average with nothing touching, before each zero touch."""

    @model_validator(mode="after")
    def _coherent(self) -> Self:
        if (self.interface == "socketcand") != (self.host is not None and self.port is not None):
            raise ValueError("host and port belong to the interface socketcand, and to no other")
        most_ms = MOST_STALE_LOOPBACK_MS if self.channel == LOOPBACK_CHANNEL else MOST_STALE_MS
        if self.stale_ms > most_ms:
            raise ValueError(
                f"stale_ms = {self.stale_ms:g}: must be from 20 to {most_ms:g}; for that long, no force is noticed"
            )
        return self


class SriM8123:
    """The force sensor. A thread reads its board; samples reach the listener in the event loop that made the driver."""

    def __init__(self, table: ForceTable, clock: Clock) -> None:
        self._table = table
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._listener: Callable[[ForceSample], None] | None = None
        self._averaged: list[Wrench] | None = None
        """Collects every round while an average is taken."""
        self.bias_wrench: Wrench = (0.0,) * 6
        """What is subtracted from every round; raw value = sample + bias."""
        self.assembler = RoundAssembler()
        """Counts the rounds that were dropped."""
        self.bus_errors = 0
        self._newest: tuple[Stamp, Wrench] | None = None
        self._alike_since = Stamp(0)
        """Of the first round in a row that exactly equals the newest; a strain gauge is never that still."""
        self._loss: tuple[str, str] | None = None
        """Why the thread ended, and what to do about it."""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="force reader", daemon=True)

    async def connect(self) -> Identity:
        """Open the bus, start the board, wait for its first whole round. Raises `ConnectionLost`, `DeviceTimeout`."""
        self._thread.start()
        try:
            async with asyncio.timeout(CONNECT_S):
                while self._newest is None:
                    self._require("connect")
                    await asyncio.sleep(RECEIVE_S)
        except TimeoutError:
            dropped = self.assembler
            what = f"no complete reading in {CONNECT_S:g} s ({dropped.torn} broken, {dropped.refused} refused)"
            remedy = "Check power, wiring, termination and bit rate."
            raise DeviceTimeout(DEVICE, "connect", what, remedy=remedy) from None
        # The board has no identification. No real board can be on a virtual bus or on the loopback rig's bus.
        interface, channel = self._table.interface, self._table.channel
        simulated = interface == "virtual" or (interface, channel) == ("socketcand", LOOPBACK_CHANNEL)
        return Identity(f"SRI M8123B2 on {interface} {channel}", "", simulated)

    def latest(self) -> ForceSample:
        """The newest sample; never blocks. Raises `Stale`, `Stuck`, `ConnectionLost`, `NotConnected`."""
        self._require("latest")
        newest, since = self._newest, self._alike_since
        if newest is None:
            raise NotConnected(DEVICE, "latest", "no sample yet")
        stamp, wrench = newest
        age_ms = (self._clock.now_ns() - stamp.host_ns) / 1e6
        if age_ms > self._table.stale_ms:
            raise Stale(DEVICE, age_ms, self._table.stale_ms, remedy="Check the sensor's power, adapter and wiring.")
        alike, alike_ms = stamp.seq - since.seq, (stamp.host_ns - since.host_ns) / 1e6
        if alike >= STUCK_ROUNDS and alike_ms > STUCK_MS:
            raise Stuck(DEVICE, alike_ms, alike)
        return self._sample(stamp, wrench)

    def listen(self, on_sample: Callable[[ForceSample], None] | None) -> None:
        """Hand every sample to `on_sample`, in the event loop; None ends it."""
        self._listener = on_sample

    async def bias(self, seconds: float) -> None:
        """Average for `seconds` with nothing touching, and subtract that from now on.

        Raises `DeviceError` if the sensor was not still, `Stale` or `DeviceTimeout` if it sent too little; the previous
        bias then remains.
        """
        self._require("bias")
        rounds = self._averaged = list[Wrench]()
        try:
            await asyncio.sleep(seconds)
        finally:
            self._averaged = None
        self.latest()
        if len(rounds) < MIN_BIAS_ROUNDS:
            what = f"{len(rounds)} readings in {seconds:g} s; {MIN_BIAS_ROUNDS} are needed"
            raise DeviceTimeout(DEVICE, "bias", what, remedy="Average for longer.")
        axes = list(zip(*rounds, strict=True))
        for name, values in zip(AXES, axes, strict=True):
            limit, unit = (STILL_N, "N") if name.startswith("F") else (STILL_NM, "Nm")
            if (deviation := statistics.stdev(values)) > limit:
                what = f"{name} varied by {deviation:.4f} {unit} (standard deviation), limit {limit:g} {unit}"
                condition = "The previous bias remains."
                remedy = "Let nothing touch the brush, wait until the arm is still, and try again."
                raise DeviceError(DEVICE, "bias", what, condition=condition, remedy=remedy)
        self.bias_wrench = tuple(statistics.fmean(values) for values in axes)

    async def close(self) -> None:
        """Stop the board, shut the bus down, join the thread; may be repeated."""
        self._closing.set()
        if self._thread.ident is not None:
            await asyncio.shield(asyncio.to_thread(self._thread.join, JOIN_S))

    def _require(self, op: str) -> None:
        if self._closing.is_set():
            raise NotConnected(DEVICE, op, "closed")
        if self._loss is not None:
            what, remedy = self._loss
            raise ConnectionLost(DEVICE, op, what, remedy=f"{too_busy()} {remedy}".strip())

    def _hear(self, stamp: Stamp, wrench: Wrench) -> None:
        if self._closing.is_set():
            return
        if self._averaged is not None:
            self._averaged.append(wrench)
        if self._listener is not None:
            self._listener(self._sample(stamp, wrench))

    def _sample(self, stamp: Stamp, wrench: Wrench) -> ForceSample:
        fx, fy, fz, mx, my, mz = (raw - bias for raw, bias in zip(wrench, self.bias_wrench, strict=True))
        return ForceSample(stamp, (fx, fy, fz), (mx, my, mz))

    # What follows runs in the thread.

    def _run(self) -> None:
        table = self._table
        try:
            import can  # slow to import, and most rigs have no such sensor

            # It warns of frames that arrive in two pieces, which is harmless; a lost frame shows in the counts.
            logging.getLogger("can").setLevel(logging.ERROR)
            gateway: dict[str, Any] = {} if table.host is None else {"host": table.host, "port": table.port}
            # Use these settings only: python-can would also read can.ini, the environment and the home folder.
            bus = can.Bus(table.channel, table.interface, ignore_config=True, bitrate=table.bitrate, **gateway)
        except Exception as error:
            # Back ends raise arbitrary exceptions if a library or a package is missing.
            what = f"cannot open {table.interface} {table.channel}: {error}"
            self._loss = (what, "Check the adapter and that its interface is up.")
            return

        def command(data: bytes) -> None:
            bus.send(can.Message(arbitration_id=COMMAND_ID, is_extended_id=False, data=data), timeout=1.0)

        try:
            command(START)
            while self._loss is None and not self._closing.is_set():
                if (message := bus.recv(RECEIVE_S)) is not None:
                    self._take(message)
        except Exception as error:
            self._lose_bus(f"failed: {error}")
        finally:
            with contextlib.suppress(can.CanError, OSError):
                command(STOP)
            bus.shutdown()

    def _take(self, message: "can.Message") -> None:
        if message.is_error_frame:
            self.bus_errors += 1
            if message.arbitration_id & BUS_OFF:
                self._lose_bus("is off after too many errors")
            return
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return
        wrench = self.assembler.feed(message.arbitration_id, bytes(message.data), message.timestamp)
        if wrench is None:
            return
        device_ns = round(message.timestamp * 1e9) or None  # 0: the adapter has no clock
        seq = self._newest[0].seq + 1 if self._newest is not None else 0
        stamp = Stamp(self._clock.now_ns(), device_ns, seq)
        if self._newest is None or wrench != self._newest[1]:
            self._alike_since = stamp
        self._newest = (stamp, wrench)
        with contextlib.suppress(RuntimeError):  # the loop ended before the stream was closed
            self._loop.call_soon_threadsafe(self._hear, stamp, wrench)

    def _lose_bus(self, what: str) -> None:
        self._loss = (
            f"the bus {self._table.interface} {self._table.channel} {what}",
            f"Check the wiring, the termination and that both ends run at {self._table.bitrate} bit/s; "
            "then set the interface down and up, and connect again.",
        )
