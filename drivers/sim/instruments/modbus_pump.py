"""A peristaltic pump with the two registers that `drivers.ink.pump` writes; serve it with `PtyLine`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink.pump import (
    MAX_RPM,
    RUN_REGISTER,
    SPEED_REGISTER,
    STOP,
    WRITE_BYTES,
    WRITE_REGISTER,
    exception,
    read_write,
    seal,
    unseal,
)

FULL_SPEED = 2


class PumpFirmware:
    """A simulated pump with `now_s` as its clock; the pumped volume can be read at any time."""

    def __init__(
        self,
        *,
        unit: int = 1,
        ml_per_revolution: float = 0.1,
        reservoir_ml: float = math.inf,
        on_pumped: Callable[[float], None] = lambda _volume_ml: None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.unit = unit
        self.rpm = 0.0
        self.starts = 0
        self._ml_per_revolution = ml_per_revolution
        self._reservoir_ml = reservoir_ml
        self._on_pumped = on_pumped
        self._now_s = now_s
        self._run = STOP
        self._pumped_ml = 0.0
        self._since_s = now_s()

    @property
    def running(self) -> bool:
        """Whether the rotor turns."""
        return self._run != STOP

    @property
    def pumped_ml(self) -> float:
        """Volume pumped so far."""
        self._settle()
        return self._pumped_ml

    def take(self, buffer: bytearray) -> bytes | None:
        """Take eight bytes, the length of every known request; None if there are fewer."""
        if len(buffer) < WRITE_BYTES:
            return None
        frame = bytes(buffer[:WRITE_BYTES])
        del buffer[:WRITE_BYTES]
        return frame

    def answer(self, request: bytes) -> bytes | None:
        """The reply; None for a wrong CRC or another unit, as Modbus requires."""
        try:
            unit, function, *_ = unseal(request)
        except ProtocolViolation:
            return None
        if unit != self.unit:
            return None
        if function != WRITE_REGISTER:
            return exception(unit, function & 0x7F, 1)
        _, register, value = read_write(request)
        self._settle()
        if register not in (SPEED_REGISTER, RUN_REGISTER):
            return exception(unit, function, 2)
        if value > (MAX_RPM * 100 if register == SPEED_REGISTER else FULL_SPEED):
            return exception(unit, function, 3)
        if register == SPEED_REGISTER:
            self.rpm = value / 100
        else:
            self.starts += value != STOP and not self.running
            self._run = value
        return request

    def damage(self, reply: bytes) -> bytes:
        """The reply with the last byte of its CRC changed."""
        return reply[:-1] + bytes([reply[-1] ^ 0x55])

    def mistake(self, reply: bytes) -> bytes:
        """A valid confirmation of another register."""
        return seal(bytes([self.unit, WRITE_REGISTER, 0x00, 0x77, 0x00, 0x00]))

    def _settle(self) -> None:
        now_s = self._now_s()
        rpm = {STOP: 0.0, FULL_SPEED: MAX_RPM}.get(self._run, self.rpm)
        turned_ml = rpm / 60.0 * self._ml_per_revolution * (now_s - self._since_s)
        volume_ml = min(turned_ml, self._reservoir_ml - self._pumped_ml)  # an empty tube pumps air
        self._pumped_ml += volume_ml
        self._on_pumped(volume_ml)
        self._since_s = now_s
