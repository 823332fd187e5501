"""The ink station: a microcontroller with a pump, a light, a lid and a level gauge, on a serial line.

Lines are `NNN words*CRC`, ASCII, ended by a line feed; see docs/ink-station.md. A request whose reply is damaged or
lost is sent again with the same number; the station answers a repeated line from memory, so that no dose is given
twice.
"""

import re
from typing import Annotated, Literal

from pydantic import Field

from brushloop.drivers.devices import Identity
from brushloop.drivers.errors import DeviceError, ProtocolViolation
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import DoseLost, InkDevice, InkRefused, InkTable, SerialPort, crc16

DEVICE = "ink"
MAX_LINE_BYTES = 96
NUMBERS = 1000
_SEALED = re.compile(rb"([0-9]{3}) ([ -)+-~]*)\*([0-9A-F]{4})\r?\n?", re.ASCII)
_REPLY = re.compile(r"ok( .*)?|err [1-9][0-9]{0,2}( .*)?")
_NUMBER = re.compile(r"[0-9]{1,6}(\.[0-9]{1,6})?")


def seal(number: int, text: str) -> bytes:
    """A line as sent over the wire; `number` is less than `NUMBERS`."""
    body = f"{number:03d} {text}".encode("ascii")
    return b"%b*%04X\n" % (body, crc16(body))


def unseal(line: bytes) -> tuple[int, str] | None:
    """(number, text) of a line, with or without its end; None if it is damaged."""
    match = _SEALED.fullmatch(line)
    if match is None or len(line) > MAX_LINE_BYTES or int(match[3], 16) != crc16(line[: match.end(2)]):
        return None
    return int(match[1]), match[2].decode("ascii")


def find_reply(received: bytes, number: int) -> str | None:
    """The text of the first complete reply to request `number`, `ok ...` or `err CODE ...`; None while there is none.

    Noise, echoes, damaged lines and replies to other requests are skipped: the sender repeats its request in time.
    """
    *lines, _ = received.split(b"\n")
    for sealed in map(unseal, lines):
        if sealed is not None and sealed[0] == number and _REPLY.fullmatch(sealed[1]):
            return sealed[1]
    return None


def number_of(word: str) -> float:
    """A plain decimal such as 1.250. Raises `ProtocolViolation`: no sign, exponent, nan or inf."""
    if not _NUMBER.fullmatch(word):
        raise ProtocolViolation(DEVICE, "decode", f"not a decimal: {word!r}")
    return float(word)


MODEL = "ink-station"
PROTOCOL = "1"
SMALLEST_ML = 0.001
LEVEL_RISES = 0.005
"""A dose that raises the level of the well by less than this has not arrived."""
FAILED = 6
"""The only refusal after which something may have been done."""
REPLY_S = 0.5
DOSE_S_PER_ML = 4.0
"""Longest time for 1 ml: the reply comes when the ink is in the well."""
ATTEMPTS, CONNECT_ATTEMPTS = 2, 6
"""Many boards restart when their port is opened, and are deaf for two seconds."""
REMEDIES = {
    1: "The firmware is older than this software; update it.",
    3: "The station's own limit is lower than the configured one; set the configured one to match.",
    4: "Refill the reservoir.",
    5: "Open the lid of the well.",
    FAILED: "Look at the pump and the lid before going on.",
}


class InkStationConfig(InkTable, frozen=True):
    """A station that doses ink, lights the sheet and measures the level (docs/ink-station.md)."""

    kind: Literal["ink-station"]
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115200
    keep_level: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Before a dip the well is filled up to this share of its capacity."""
    dose_ml: Annotated[float, Field(gt=0.0, le=2.0)] = 0.5
    """Size of one dose, repeated until the level is reached."""
    light: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Set at the start of a run; if left out, the light stays as it is."""

    def device(self, clock: Clock) -> InkDevice:
        """The driver, not yet connected."""
        return InkStation(self, clock)


class InkStation(InkDevice):
    """The station, over its line protocol."""

    def __init__(self, table: InkStationConfig, clock: Clock) -> None:
        super().__init__(DEVICE, table, clock, smallest_ml=SMALLEST_ML)
        self._keep_level, self._light = table.keep_level, table.light
        self._port = SerialPort(DEVICE, table.port, table.baud)
        self._number = 0

    async def connect(self) -> Identity:
        """Open the port and learn who answers; moves nothing. Raises `DeviceError`."""
        await self._port.open()
        answer = await self._ask("identify", attempts=CONNECT_ATTEMPTS)
        match answer.split(" "):
            case [model, version, firmware, ("real" | "loopback") as kind] if (model, version) == (MODEL, PROTOCOL):
                return Identity(MODEL, firmware, kind == "loopback")
            case _:
                what = f"identifies as {answer!r}, expected {MODEL} with protocol {PROTOCOL}"
                remedy = "Check that this is the port of the ink station, and check its firmware."
                raise ProtocolViolation(DEVICE, "connect", what, remedy=remedy)

    async def _give(self, volume_ml: float) -> None:
        """Return when the ink is in the well. A dose that was sent cannot be interrupted, which is why it is small."""
        unknown = f"It is unknown how much of {volume_ml:.3f} ml reached the well."
        answer = await self._ask(f"dose {volume_ml:.3f}", takes_s=volume_ml * DOSE_S_PER_ML, condition=unknown)
        given_ml = number_of(answer)
        if abs(given_ml - volume_ml) > max(2 * SMALLEST_ML, 0.05 * volume_ml):
            raise DeviceError(DEVICE, "dose", f"gave {given_ml:.3f} ml instead of {volume_ml:.3f} ml")

    async def replenish(self) -> float:
        """Dose until the gauge shows `keep_level`. Raises `DoseLost` if a dose does not arrive, and as `dose` does."""
        level, dose_ml = await self.level(), self._table.dose_ml
        while level < self._keep_level:
            await self.dose(dose_ml)
            before, level = level, await self.level()
            if level < before + LEVEL_RISES:
                raise DoseLost(DEVICE, "dose", f"after a dose of {dose_ml:g} ml the well is still at {level:.0%}")
        return level

    async def light(self) -> float | None:
        """Set the light as the table says; return it, None if the table says nothing. Raises as `level` does."""
        if self._light is not None:
            await self._ask(f"light {self._light:.3f}")
        return self._light

    async def level(self) -> float:
        """Fill level of the well, 0 to 1. Raises `InkRefused`, `DeviceError`."""
        level = number_of(await self._ask("level"))
        if level > 1.0:
            raise ProtocolViolation(DEVICE, "level", f"level is {level:g}, above 1")
        return level

    async def close(self) -> None:
        """Close the port; light and lid stay as they are."""
        await self._port.close()

    async def _ask(self, words: str, *, takes_s: float = 0.0, attempts: int = ATTEMPTS, condition: str = "") -> str:
        """What follows `ok` in the reply. Raises `InkRefused` for `err`, and what `SerialPort.exchange` raises."""
        number, self._number = self._number, (self._number + 1) % NUMBERS
        op = words.partition(" ")[0]
        text = await self._port.exchange(
            op,
            seal(number, words),
            lambda received: find_reply(received, number),
            timeout_s=REPLY_S + takes_s,
            attempts=attempts,
            condition=condition,
        )
        first, _, values = text.partition(" ")
        if first == "ok":
            return values
        code, _, reason = values.partition(" ")
        condition = condition if int(code) == FAILED else "Nothing was done."
        what = f"refused with {code} ({reason})"
        raise InkRefused(DEVICE, op, what, condition=condition, remedy=REMEDIES.get(int(code), ""))
