"""A peristaltic pump on Modbus RTU (RS-485).

The register map is from public third-party code, not from the maker's manual, and no pump has confirmed it yet:
register 1 is the speed in 0.01 rpm, register 4 is 1 to start, 0 to stop, 2 for full speed. Only replies
to writes are certain, so nothing is read: neither the pump's identity nor the level of the well is known.

| frame | bytes |
|---|---|
| request | unit, 06, register (2, high first), value (2, high first), CRC (2, low first) |
| reply | the request again |
| exception | unit, 86, code, CRC (2, low first) |
"""

import asyncio
import struct
import time
from typing import Annotated, Literal

from pydantic import Field

from brushloop.drivers.devices import Identity
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, NotConnected, ProtocolViolation
from brushloop.drivers.host import Clock, finished
from brushloop.drivers.ink.port import InkDevice, InkRefused, InkTable, SerialPort, crc16

DEVICE = "pump"
WRITE_REGISTER = 0x06
EXCEPTION_BIT = 0x80
EXCEPTION_BYTES = 5
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal register",
    3: "illegal value",
    4: "device failure",
    5: "accepted, still working",
    6: "busy",
}


def seal(body: bytes) -> bytes:
    """`body` with its CRC, low byte first."""
    return body + struct.pack("<H", crc16(body))


def write_register(unit: int, register: int, value: int) -> bytes:
    """The request to write one register."""
    return seal(struct.pack(">BBHH", unit, WRITE_REGISTER, register, value))


def find_reply(received: bytes, request: bytes) -> int | None:
    """0 if `received` confirms `request`, the code if it is an exception, None while it is neither.

    Noise before the reply is skipped: the CRC decides where a frame is. Of two replies the one that ends first
    counts, so the result does not depend on how the bytes were split.
    """
    head = bytes([request[0], request[1] | EXCEPTION_BIT])
    for end in range(EXCEPTION_BYTES, len(received) + 1):
        if received.endswith(request, 0, end):
            return 0
        frame = received[end - EXCEPTION_BYTES : end]
        # Code 0 is not an exception, and would read as a confirmation.
        if frame.startswith(head) and seal(frame[:3]) == frame and frame[2]:
            return frame[2]
    return None


SPEED_REGISTER = 1
RUN_REGISTER = 4
STOP, START = 0, 1
MAX_RPM = 600.0
"""The speed register could hold up to 655.35."""
REPLY_S = 0.5
ECHO_S = 0.15
"""How long `connect` waits for an echo: longer than eight characters and the adapter's own delay."""
MAX_OVERRUN_S = 0.5
"""A stop that is later than this is reported: the well got more than was asked for."""


class ModbusPumpConfig(InkTable, frozen=True):
    """A peristaltic pump without a gauge: replaces the ink that dips take without measuring it."""

    kind: Literal["modbus-pump"]
    ml_per_revolution: Annotated[float, Field(gt=0.0, lt=100.0)]
    """Calibrated: weigh what 100 revolutions deliver. A tube wears, so it is worth repeating."""
    rpm: Annotated[float, Field(gt=0.0, le=MAX_RPM)] = 50.0
    unit: Annotated[int, Field(ge=1, le=247)] = 1
    baud: Annotated[int, Field(ge=1200, le=115200)] = 9600
    dose_ml: Annotated[float, Field(gt=0.0, le=2.0)] = 0.3
    """Dose before every `every_dips`-th dip."""
    every_dips: Annotated[int, Field(ge=1, le=1000)] = 5

    def device(self, clock: Clock) -> InkDevice:
        """The driver, not yet connected."""
        return ModbusPump(self, clock)

    def doses_ml(self, dips: int) -> float:
        """Ink that the pump doses in so many dips."""
        return dips // self.every_dips * self.dose_ml


class ModbusPump(InkDevice):
    """The pump, which doses by time at a fixed speed; a running pump is always stopped."""

    def __init__(self, table: ModbusPumpConfig, clock: Clock) -> None:
        self._ml_per_s = table.ml_per_revolution * table.rpm / 60.0
        # Below a tenth of a second the time that messages take would matter more than the time pumped.
        super().__init__(DEVICE, table, clock, smallest_ml=0.1 * self._ml_per_s)
        self._unit, self._rpm, self._every_dips = table.unit, table.rpm, table.every_dips
        # 3.5 characters of 11 bits, at least 1.75 ms: the silence that ends a frame.
        self._port = SerialPort(DEVICE, table.port, table.baud, max(0.00175, 3.5 * 11 / table.baud))
        self._running = asyncio.Lock()
        self._connected = False
        self._may_run = False
        self._dips = 0

    async def connect(self) -> Identity:
        """Open the port, check that the line does not echo, and stop the pump. Raises `DeviceError`."""
        await self._port.open()
        await self._refuse_echo()
        await self._halt()
        self._connected = True
        # A pump cannot say whether it is the loopback rig's.
        return Identity(f"Modbus RTU pump, unit {self._unit}", "", False)

    async def _give(self, volume_ml: float) -> None:
        """Pump for as long as `volume_ml` takes, then stop.

        On any error, including cancellation, the pump is stopped before the error is passed on.
        """
        async with self._running:
            speed = round(self._rpm * 100)
            await self._write(SPEED_REGISTER, speed, "set speed", "The pump was not started.")
            planned_s = volume_ml / self._ml_per_s
            if not self._connected:  # closed meanwhile: the stop has been sent, and no start may follow
                raise NotConnected(DEVICE, "dose", "closed while waiting", condition="The pump was not started.")
            try:
                self._may_run = True
                await self._write(RUN_REGISTER, START, "start", "The pump is stopped.")
                began_s = time.monotonic()
                await asyncio.sleep(planned_s)
            except BaseException as error:
                try:
                    await finished(self._halt())
                except DeviceError as failure:  # it outweighs a failed start, but must not swallow a cancellation
                    if isinstance(error, DeviceError):
                        raise
                    error.add_note(str(failure))
                raise
            ran_s = time.monotonic() - began_s
            await finished(self._halt())
            if ran_s > planned_s + MAX_OVERRUN_S:
                excess_ml = (ran_s - planned_s) * self._ml_per_s
                what, remedy = f"the pump ran {ran_s:.2f} s instead of {planned_s:.2f} s", "The computer was delayed."
                condition = f"About {excess_ml:.2f} ml too much is in the well; the pump is stopped."
                raise DeviceError(DEVICE, "dose", what, condition=condition, remedy=remedy)

    async def replenish(self) -> None:
        """Dose before every `every_dips`-th dip since `connect`. Raises as `dose` does, and does not count that dip."""
        if self._dips % self._every_dips == self._every_dips - 1:
            await self.dose(self._table.dose_ml)
        self._dips += 1

    async def close(self) -> None:
        """Stop the pump once more, then close the port. Raises `DeviceError` only if the pump may still be running."""
        connected, self._connected = self._connected, False
        try:
            if connected:
                await self._halt()
        except DeviceError:
            if self._may_run:
                raise
        finally:
            await self._port.close()

    async def _halt(self) -> None:
        """Stop the pump, with retries: a pump that runs on is worse than a late error."""
        for left in (2, 1, 0):
            try:
                await self._write(RUN_REGISTER, STOP, "stop", "The pump may still be running.")
            except DeviceError as error:
                if not left or isinstance(error, ConnectionLost | NotConnected):
                    raise
            else:
                self._may_run = False
                return

    async def _write(self, register: int, value: int, op: str, condition: str) -> None:
        request = write_register(self._unit, register, value)
        code = await self._port.exchange(
            op, request, lambda received: find_reply(received, request), timeout_s=REPLY_S, condition=condition
        )
        if code:
            what = f"refused with {code} ({EXCEPTIONS.get(code, 'unknown')})"
            raise InkRefused(DEVICE, op, what, condition=condition, remedy="Does the pump have other registers?")

    async def _refuse_echo(self) -> None:
        """Send a stop with a wrong CRC, which no device answers, and raise if the adapter returns it.

        The reply to a write is the request itself, so an echo would look like a pump that obeys.
        """
        intact = write_register(self._unit, RUN_REGISTER, STOP)
        damaged = intact[:-2] + bytes(byte ^ 0xFF for byte in intact[-2:])
        try:
            await self._port.exchange(
                "connect", damaged, lambda received: True if damaged in received else None, timeout_s=ECHO_S
            )
        except (DeviceTimeout, ProtocolViolation):
            return
        what = "the serial line echoes what is sent: a confirmation would prove nothing"
        remedy = "Switch off local echo on the RS-485 adapter."
        raise ProtocolViolation(DEVICE, "connect", what, remedy=remedy)
