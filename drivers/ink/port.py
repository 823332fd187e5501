"""What ink devices share: their table in `rig.toml`, the serial line, its checksum, limits on doses, and errors.

One worker thread owns the port from open to close, so that an exchange whose caller was cancelled still ends before
the next begins: two requests at once on a half-duplex line would destroy each other.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Protocol, TypeVar, cast

from pydantic import BaseModel, Field

from brushloop.drivers.devices import Ink
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    ProtocolViolation,
)
from brushloop.drivers.host import Clock


class InkRefused(DeviceError):
    """The device understood the request and refused it; `code` is the device's number for the reason."""

    def __init__(self, device: str, op: str, code: int, text: str, *, condition: str = "", remedy: str = "") -> None:
        self.code = code
        super().__init__(device, op, f"refused with {code} ({text})", condition=condition, remedy=remedy)


class DoseLost(DeviceError):
    """A dose was given, and the well does not show it."""


class InkTable(BaseModel, ABC, frozen=True, extra="forbid"):
    """The table `[ink.device]` of `rig.toml` for one kind of ink device: the engine asks it for everything."""

    kind: str
    port: str = Field(min_length=1)
    """Device file or COM port, or what else the device is reached by."""
    dose_ml: Annotated[float, Field(gt=0.0, le=2.0)]
    """Size of one dose."""

    @abstractmethod
    def device(self, clock: Clock) -> Ink:
        """The driver, not yet connected."""

    def doses_ml(self, dips: int) -> float | None:
        """Ink that so many dips cost where the device counts dips; None where a gauge or a person decides."""
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


MINUTE_NS = 60 * 10**9


class DoseBudget:
    """A limit per dose and one per minute, both in ml.

    A dose that failed still counts: ink may have flowed before the reply was lost.
    """

    def __init__(self, device: str, *, smallest_ml: float, max_dose_ml: float, max_per_minute_ml: float) -> None:
        self._device = device
        self._smallest_ml = smallest_ml
        self._max_dose_ml = max_dose_ml
        self._max_per_minute_ml = max_per_minute_ml
        self._given: deque[tuple[int, float]] = deque()

    def take(self, volume_ml: float, now_ns: int) -> None:
        """Count a dose at `now_ns`. Raises `LimitExceeded` without counting it."""
        if not math.isfinite(volume_ml) or not self._smallest_ml * (1 - 1e-9) <= volume_ml <= self._max_dose_ml:
            raise LimitExceeded(self._device, "dose", volume_ml, self._smallest_ml, self._max_dose_ml, "ml")
        while self._given and now_ns - self._given[0][0] >= MINUTE_NS:
            self._given.popleft()
        within_ml = volume_ml + sum(ml for _, ml in self._given)
        if within_ml > self._max_per_minute_ml * (1 + 1e-9):
            raise LimitExceeded(self._device, "dose per minute", within_ml, 0.0, self._max_per_minute_ml, "ml")
        self._given.append((now_ns, volume_ml))


MAX_REPLY_BYTES = 4096
"""Far above any reply; a device that sends without end must not fill the memory."""
POLL_S = 0.02
REPLUG = "Check cable, power and the path of the port, then connect again."

T = TypeVar("T")


class _Port(Protocol):
    """The part of pyserial's API that is used; pyserial ships no types."""

    @property
    def in_waiting(self) -> int: ...
    def read(self, size: int) -> bytes: ...
    def write(self, data: bytes) -> int | None: ...
    def close(self) -> None: ...


class SerialPort:
    """Requests and replies over pyserial, without blocking the event loop."""

    def __init__(self, device: str, path: str, baud: int, gap_s: float = 0.0) -> None:
        """`path` is the device file or COM port; `gap_s` a silence before each request, which separates frames in
        Modbus RTU."""
        self._device = device
        self._path = path
        self._baud = baud
        self._gap_s = gap_s
        self._worker: ThreadPoolExecutor | None = None
        self._port: _Port | None = None
        self._lost: str | None = None
        self._closing = threading.Event()

    async def open(self) -> None:
        """Open the port for this process alone. Raises `ConnectionLost`."""
        await self.close()
        self._lost, self._closing = None, threading.Event()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=f"serial {self._path}")
        try:
            await asyncio.get_running_loop().run_in_executor(self._worker, self._open)
        except BaseException:
            await self.close()
            raise

    async def exchange(
        self, op: str, request: bytes, find: Callable[[bytes], T | None], *, timeout_s: float, condition: str = ""
    ) -> T:
        """Send `request`, then pass all bytes received so far to `find` until it returns a reply.

        Raises `DeviceTimeout` if nothing arrived, `ProtocolViolation` if something else arrived, `ConnectionLost`,
        `NotConnected`, each with `condition`.
        """
        if self._worker is None:
            raise NotConnected(self._device, op, "not connected")
        loop, closing = asyncio.get_running_loop(), self._closing
        try:
            received, reply = await loop.run_in_executor(
                self._worker, lambda: self._ask(op, request, find, timeout_s, closing)
            )
        except ConnectionLost as error:
            raise ConnectionLost(self._device, op, error.what, condition=condition, remedy=REPLUG) from None
        if reply is not None:
            return reply
        if received:
            raise ProtocolViolation(
                self._device, op, f"no reply among {shown(received)} in {timeout_s:g} s", condition=condition
            )
        raise DeviceTimeout(
            self._device, op, f"no reply in {timeout_s:g} s", condition=condition, remedy="Check power and cable."
        )

    async def close(self) -> None:
        """Abandon a pending exchange, close the port and join the worker; may be repeated."""
        self._closing.set()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.submit(self._close)
            await asyncio.shield(asyncio.to_thread(worker.shutdown))

    def _open(self) -> None:
        import serial

        try:
            port = serial.Serial(self._path, self._baud, timeout=POLL_S, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError) as error:  # pyserial's own error is an OSError
            why = f"cannot open {self._path}: {error}"
            raise ConnectionLost(self._device, "connect", why, remedy=REPLUG) from None
        self._port = cast("_Port", port)

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()

    def _ask(
        self,
        op: str,
        request: bytes,
        find: Callable[[bytes], T | None],
        timeout_s: float,
        closing: threading.Event,
    ) -> tuple[bytes, T | None]:
        if self._lost is not None:
            raise ConnectionLost(self._device, op, self._lost)
        port = self._port
        if port is None or closing.is_set():
            raise NotConnected(self._device, op, "closed while waiting")
        try:
            time.sleep(self._gap_s)
            if waiting := port.in_waiting:
                port.read(waiting)  # late replies and noise from before this request
            port.write(request)
            received = b""
            deadline_s = time.monotonic() + timeout_s
            while time.monotonic() < deadline_s:
                if closing.is_set():
                    raise NotConnected(self._device, op, "closed while waiting")
                if not (arrived := port.read(max(1, port.in_waiting))):
                    continue
                received += arrived
                if (reply := find(received)) is not None:
                    return received, reply
                if len(received) > MAX_REPLY_BYTES:
                    break
            return received, None
        except OSError as error:
            self._lost = f"{self._path}: {error.strerror or error}"
            raise ConnectionLost(self._device, op, self._lost) from None


def shown(data: bytes) -> str:
    """The first bytes of `data`, formatted for a message."""
    return f"{data[:48]!r}{'...' if len(data) > 48 else ''}"
