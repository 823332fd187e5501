"""What ink devices share: their table in `rig.toml`, the limits on doses, errors, and the serial line.

An exchange whose caller was cancelled still ends before the next begins: two requests at once on a half-duplex line
would destroy each other.
"""

import asyncio
import contextlib
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field

from brushloop.drivers.devices import Device
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    ProtocolViolation,
)
from brushloop.drivers.host import Clock, finished


class InkRefused(DeviceError):
    """The device understood the request and refused it; the message has its number for the reason."""


class DoseLost(DeviceError):
    """A dose was given, and the well does not show it."""

    condition = "Nothing was dipped."
    remedy = "Look at the tube, the reservoir and the gauge."


class InkTable(BaseModel, ABC, frozen=True, extra="forbid"):
    """The table `[ink.device]` of `rig.toml` for one kind of ink device: the engine asks it for everything."""

    kind: str
    port: str = Field(min_length=1)
    """Device file, COM port or URL of pyserial, or what else the device is reached by."""
    dose_ml: Annotated[float, Field(gt=0.0, le=2.0)]
    """Size of one dose."""
    max_per_minute_ml: Annotated[float, Field(gt=0.0, le=100.0)] = 5.0

    @abstractmethod
    def device(self, clock: Clock) -> "InkDevice":
        """The driver, not yet connected."""

    def doses_ml(self, dips: int) -> float | None:
        """Ink that so many dips cost where the device counts dips; None where a gauge or a person decides."""
        return None


MINUTE_NS = 60 * 10**9


class InkDevice(Device, ABC):
    """A `Device` that keeps the well filled as its table says. Connecting gives no ink.

    It keeps to the limit of a dose and of a minute, and adds up what it has given. A dose that failed counts against
    the limits: ink may have flowed before the reply was lost.
    """

    def __init__(self, name: str, table: InkTable, clock: Clock, *, smallest_ml: float) -> None:
        self._name, self._table, self._clock = name, table, clock
        self._smallest_ml = smallest_ml
        self._taken: list[tuple[int, float]] = []
        """Times and volumes of the doses of the last minute."""
        self.dosed_ml = 0.0
        """What the device has given, by a replenishing that failed half way too."""

    @abstractmethod
    async def replenish(self) -> float | None:
        """Before a dip: add ink if the table asks for it. Returns the level of the well, as `level` does.

        Raises `InkRefused` or `DoseLost` where only a person can help, else `DeviceError`.
        """

    @abstractmethod
    async def _give(self, volume_ml: float) -> None:
        """Add ink to the well; returns when it is in."""

    async def dose(self, volume_ml: float) -> None:
        """Add ink to the well. Raises `LimitExceeded` before anything is sent, `InkRefused`, `DeviceError`."""
        now_ns, most_ml, a_minute_ml = self._clock.now_ns(), self._table.dose_ml, self._table.max_per_minute_ml
        if not math.isfinite(volume_ml) or not self._smallest_ml * (1 - 1e-9) <= volume_ml <= most_ml:
            raise LimitExceeded(self._name, "dose", volume_ml, self._smallest_ml, most_ml, "ml")
        self._taken = [(at_ns, ml) for at_ns, ml in self._taken if now_ns - at_ns < MINUTE_NS]
        within_ml = volume_ml + sum(ml for _, ml in self._taken)
        if within_ml > a_minute_ml * (1 + 1e-9):
            raise LimitExceeded(self._name, "dose per minute", within_ml, 0.0, a_minute_ml, "ml")
        self._taken.append((now_ns, volume_ml))
        await self._give(volume_ml)
        self.dosed_ml += volume_ml

    async def light(self) -> float | None:
        """Set the light over the sheet as the table says and return it, 0 to 1; None where there is none to set."""
        return None

    async def level(self) -> float | None:
        """Fill level of the well, 0 to 1; None where the device has no gauge."""
        return None


_POLYNOMIAL = 0xA001  # 0x8005, reflected


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS of `data`: 0x4B37 for b"123456789"."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (_POLYNOMIAL if crc & 1 else 0)
    return crc


POLL_S = 0.02
STALE_BYTES = 4096
"""More than can wait on a line; pyserial does not count what waits where a network carries the line."""
REPLUG = "Check cable, power and the path of the port, then connect again."

T = TypeVar("T")


class SerialPort:
    """Requests and replies over pyserial, without blocking the event loop."""

    def __init__(self, device: str, path: str, baud: int, gap_s: float = 0.0) -> None:
        """`path` is a device file, COM port or URL of pyserial; `gap_s` a silence before each request, which separates
        frames in Modbus RTU."""
        self._device = device
        self._path = path
        self._baud = baud
        self._gap_s = gap_s
        self._port: Any = None
        """A `serial.Serial`; pyserial ships no types."""
        self._turn = asyncio.Lock()
        self._closing = threading.Event()

    async def open(self) -> None:
        """Open the port for this process alone. Raises `ConnectionLost`."""
        import serial

        try:
            self._port = await asyncio.to_thread(
                serial.serial_for_url, self._path, self._baud, timeout=POLL_S, write_timeout=1.0, exclusive=True
            )
        except (OSError, ValueError) as error:
            why = f"cannot open {self._path}: {error}"
            raise ConnectionLost(self._device, "connect", why, remedy=REPLUG) from None

    async def exchange(
        self,
        op: str,
        request: bytes,
        find: Callable[[bytes], T | None],
        *,
        timeout_s: float,
        attempts: int = 1,
        condition: str = "",
    ) -> T:
        """Send `request`, then pass all bytes received so far to `find` until it returns a reply.

        Where none comes in `timeout_s`, the same request is sent again, up to so many `attempts` in all.
        Raises `DeviceTimeout` if nothing arrived, `ProtocolViolation` if something else arrived, `ConnectionLost`,
        `NotConnected`, each with `condition`.
        """

        async def in_turn() -> tuple[bytes, T | None]:
            async with self._turn:
                return await asyncio.to_thread(self._ask, op, request, find, timeout_s)

        received = b""
        for _ in range(attempts):
            try:
                received, reply = await asyncio.shield(in_turn())
            except OSError as error:  # pyserial's own error is an OSError
                what = f"{self._path}: {error.strerror or error}"
                raise ConnectionLost(self._device, op, what, condition=condition, remedy=REPLUG) from None
            if reply is not None:
                return reply
        if received:
            start = f"{received[:48]!r}{'...' if len(received) > 48 else ''}"
            what = f"no reply among {start} in {timeout_s:g} s"
            raise ProtocolViolation(self._device, op, what, condition=condition)
        what = f"no reply in {timeout_s:g} s"
        raise DeviceTimeout(self._device, op, what, condition=condition, remedy="Check power and cable.")

    async def close(self) -> None:
        """Abandon a pending exchange and close the port; may be repeated."""
        self._closing.set()
        await finished(self._close())

    async def _close(self) -> None:
        async with self._turn:
            port, self._port = self._port, None
            if port is not None:
                with contextlib.suppress(OSError):
                    await asyncio.to_thread(port.close)

    def _ask(
        self, op: str, request: bytes, find: Callable[[bytes], T | None], timeout_s: float
    ) -> tuple[bytes, T | None]:
        """Everything received, and the reply in it. Raises `NotConnected` if the port is not open, `OSError`."""
        port = self._port
        if port is None or self._closing.is_set():
            raise NotConnected(self._device, op, "not connected")
        time.sleep(self._gap_s)
        if port.in_waiting:
            port.read(STALE_BYTES)  # late replies and noise from before this request
        deadline_s = time.monotonic() + timeout_s
        port.write(request)
        received = b""
        while time.monotonic() < deadline_s:
            if self._closing.is_set():
                raise NotConnected(self._device, op, "closed while waiting")
            received += port.read(max(1, port.in_waiting))
            if (reply := find(received)) is not None:
                return received, reply
        return received, None
