"""Serial instruments: the ink station's firmware, a Modbus pump, and the line and faults that both share."""

import asyncio
import struct
import time
from collections.abc import Callable

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink import pump
from brushloop.drivers.ink.station import number_of, seal, unseal
from brushloop.drivers.loopback import LoopbackServer

GARBAGE = b"\xff\x00*\n\x86\x01ok 1*0000\n"
LATE_S = 0.3
RESERVOIR_ML = 100.0


BRUSH_ML = 0.5
"""Volume of ink that a dry brush absorbs."""


class Well:
    """The ink well, a straight pot whose bottom is at height 0: dips lower its level, doses raise it."""

    def __init__(self, ml_per_mm: float = 1.0, level_mm: float = 10.0, depth_mm: float = 20.0) -> None:
        self.ml = level_mm * ml_per_mm
        self.capacity_ml = depth_mm * ml_per_mm
        self._ml_per_mm = ml_per_mm

    @property
    def level_mm(self) -> float:
        """Height of the ink above the bottom."""
        return self.ml / self._ml_per_mm

    @property
    def share(self) -> float:
        """Fill level, 0 to 1."""
        return min(1.0, self.ml / self.capacity_ml)

    def add(self, volume_ml: float) -> None:
        """Add a dose; any excess is lost."""
        self.ml = min(self.capacity_ml, self.ml + volume_ml)

    def dip(self, ink_load: float) -> float:
        """Fill a brush that holds `ink_load` (0 to 1); return its new load."""
        taken_ml = min(self.ml, (1.0 - ink_load) * BRUSH_ML)
        self.ml -= taken_ml
        return ink_load + taken_ml / BRUSH_ML


class StationFirmware:
    """The ink station's side of docs/ink-station.md, with a well, a reservoir and a light; its lid is always open."""

    def __init__(self, well: Well | None = None) -> None:
        self.well = well or Well()
        self.reservoir_ml = RESERVOIR_ML
        self.light = 0.0
        self._memory: tuple[bytes, bytes] = (b"", b"")

    async def take(self, reader: asyncio.StreamReader) -> bytes:
        """Read one line."""
        return await reader.readuntil(b"\n")

    def answer(self, request: bytes) -> bytes | None:
        """The reply; a repeated line is answered from memory, a damaged one not at all."""
        if request == self._memory[0]:
            return self._memory[1]
        if (sealed := unseal(request)) is None:
            return None  # the number that it carries cannot be trusted
        number, command = sealed
        try:
            text = self._obey(command.split(" "))
        except ProtocolViolation:
            text = "err 2 not a number"
        reply = seal(number, text)
        self._memory = (request, reply)
        return reply

    def _obey(self, words: list[str]) -> str:
        match words:
            case ["identify"]:
                return "ok ink-station 1 1.0.0 loopback"
            case ["dose", volume]:
                return self._dose(number_of(volume))
            case ["light", level]:
                if number_of(level) > 1.0:
                    return "err 2 light goes to 1"
                self.light = number_of(level)
                return "ok"
            case ["level"]:
                return f"ok {self.well.share:.3f}"
            case _:
                return "err 1 unknown command"

    def _dose(self, volume_ml: float) -> str:
        if volume_ml > self.reservoir_ml:
            return "err 4 reservoir is empty"
        if self.well.ml + volume_ml > self.well.capacity_ml:
            return "err 3 well would overflow"
        self.reservoir_ml -= volume_ml
        self.well.add(volume_ml)
        return f"ok {volume_ml:.3f}"


REQUEST_BYTES = 8
PUMP_ML = 0.1
"""Delivery of the pump, ml per revolution."""


class PumpFirmware:
    """A simulated pump, unit 1 on its line."""

    def __init__(self, well: Well | None = None, *, ml_per_revolution: float = PUMP_ML) -> None:
        self.well = well or Well()
        self.rpm = 0.0
        self.starts = 0
        self.running = False
        self._ml_per_revolution = ml_per_revolution
        self._since_s = time.monotonic()

    async def take(self, reader: asyncio.StreamReader) -> bytes:
        """Read eight bytes, the length of every known request."""
        return await reader.readexactly(REQUEST_BYTES)

    def answer(self, request: bytes) -> bytes | None:
        """The request again; None for a wrong CRC or another unit, as Modbus requires, and for what no driver sends."""
        unit, function, register, value = struct.unpack(">BBHH", request[:-2])
        if pump.seal(request[:-2]) != request or (unit, function) != (1, pump.WRITE_REGISTER):
            return None
        self._settle()
        if register == pump.SPEED_REGISTER:
            self.rpm = value / 100
        elif register == pump.RUN_REGISTER:
            self.starts += value != pump.STOP and not self.running
            self.running = value != pump.STOP
        return request

    def _settle(self) -> None:
        now_s = time.monotonic()
        ml_per_s = (self.rpm if self.running else 0.0) / 60.0 * self._ml_per_revolution
        self.well.add(ml_per_s * (now_s - self._since_s))
        self._since_s = now_s


class InstrumentServer(LoopbackServer):
    """An instrument whose serial line is carried by a network: pyserial opens it by `socket://HOST:PORT`.

    Its method `take` reads one request; `answer` carries it out and returns the reply, None for silence.
    """

    def __init__(self, instrument: StationFirmware | PumpFirmware) -> None:
        super().__init__()
        self.instrument = instrument
        self.next_fault: Callable[[], str | None] = lambda: None
        """Asked for the fault of each request."""

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer requests until the client disconnects."""
        while True:
            request = await self.instrument.take(reader)
            fault = self.next_fault()
            if fault == "unplug":
                assert self._server is not None
                self._server.close()
                self.drop_clients()
                return
            reply = None if fault == "deaf" else self.instrument.answer(request)
            if reply is None or fault == "mute":
                continue
            if fault == "late":
                asyncio.get_running_loop().call_later(LATE_S, self.write, writer, reply)
            else:
                self.write(writer, GARBAGE if fault == "garbage" else reply)
