"""The ink station: a microcontroller with a pump, a light, a lid and a level gauge, on a serial line.

Lines are `NNN words*CRC`, ASCII, ended by a line feed; see docs/ink-station.md. A request whose reply is damaged or
lost is sent again with the same number; the station answers a repeated line from memory, so that no dose is given
twice.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from brushloop.drivers.devices import Identity, Well
from brushloop.drivers.errors import DeviceError, DeviceTimeout, ProtocolViolation
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import DoseBudget, DoseLost, InkRefused, InkTable, SerialPort, crc16

DEVICE = "ink"
MAX_LINE_BYTES = 96
NUMBERS = 1000
_SEALED = re.compile(rb"([0-9]{3}) ([ -)+-~]*)\*([0-9A-F]{4})\r?\n?", re.ASCII)
_REFUSAL = re.compile(r"err ([0-9]{1,3})(?: (.*))?")
_NUMBER = re.compile(r"[0-9]{1,6}(\.[0-9]{1,6})?")


@dataclass(frozen=True, slots=True)
class Line:
    """A valid line: its sequence number and its text."""

    number: int
    text: str


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply `ok` with its values, or `err` with `code` above zero and a text."""

    values: tuple[str, ...] = ()
    code: int = 0
    text: str = ""


def seal(number: int, text: str) -> bytes:
    """A line as sent over the wire. Raises ValueError for text that a line cannot carry."""
    body = f"{number:03d} {text}".encode("ascii")
    line = b"%b*%04X\n" % (body, crc16(body))
    if not 0 <= number < NUMBERS or len(line) > MAX_LINE_BYTES or not _SEALED.fullmatch(line):
        raise ValueError(f"not a line: {number} {text!r}")
    return line


def unseal(line: bytes) -> Line:
    """Number and text of a line, with or without its end. Raises `ProtocolViolation`."""
    match = _SEALED.fullmatch(line)
    if match is None or len(line) > MAX_LINE_BYTES:
        raise ProtocolViolation(DEVICE, "decode", f"not a line: {line[:48]!r}")
    number, text, crc = match.groups()
    body = line[: match.end(2)]
    if int(crc, 16) != crc16(body):
        raise ProtocolViolation(DEVICE, "decode", f"checksum of {line[:48]!r} is {crc16(body):04X}")
    return Line(int(number), text.decode("ascii"))


def find_reply(received: bytes, number: int) -> Reply | None:
    """The first complete reply to request `number`; None while there is none.

    Noise, echoes, damaged lines and replies to other requests are skipped: the sender repeats its request in time.
    """
    *lines, _ = received.split(b"\n")
    for raw in lines:
        try:
            line = unseal(raw)
        except ProtocolViolation:
            continue
        if line.number == number and (reply := _parse(line.text)) is not None:
            return reply
    return None


def _parse(text: str) -> Reply | None:
    first, *values = text.split(" ")
    if first == "ok":
        return Reply(tuple(values))
    if (refusal := _REFUSAL.fullmatch(text)) and int(refusal[1]):
        return Reply(code=int(refusal[1]), text=refusal[2] or "")
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
    max_per_minute_ml: Annotated[float, Field(gt=0.0, le=100.0)] = 5.0
    light: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Set at the start of a run; if left out, the light stays as it is."""

    def device(self, clock: Clock) -> InkStation:
        """The driver, not yet connected."""
        return InkStation(self, clock)


class InkStation:
    """`Ink` over the station's line protocol."""

    def __init__(
        self,
        config: InkStationConfig,
        clock: Clock,
        *,
        timeout_s: float = 0.5,
        s_per_ml: float = 4.0,
        attempts: int = 2,
        connect_attempts: int = 6,
    ) -> None:
        """`s_per_ml`: longest time for 1 ml; the reply comes when the ink is in the well. `connect_attempts`: many
        boards restart when their port is opened, and are deaf for two seconds."""
        self._config, self._clock = config, clock
        self._timeout_s = timeout_s
        self._s_per_ml = s_per_ml
        self._attempts, self._connect_attempts = attempts, connect_attempts
        self._port = SerialPort(DEVICE, config.port, config.baud)
        self._budget = DoseBudget(
            DEVICE, smallest_ml=SMALLEST_ML, max_dose_ml=config.dose_ml, max_per_minute_ml=config.max_per_minute_ml
        )
        self._number, self._dosed_ml = 0, 0.0

    async def connect(self) -> Identity:
        """Open the port and learn who answers; moves nothing. Raises `DeviceError`; nothing is left open then."""
        self._number, self._dosed_ml = 0, 0.0
        await self._port.open()
        try:
            return await self._identify()
        except BaseException:
            await self._port.close()
            raise

    async def dose(self, volume_ml: float) -> None:
        """Add ink to the well; returns when it is in. Raises `LimitExceeded`, `InkRefused`, `DeviceError`.

        It cannot be interrupted once it is sent, which is why a dose is small.
        """
        self._budget.take(volume_ml, self._clock.now_ns())
        unknown = f"Between 0 and {volume_ml:.3f} ml may be in the well."
        timeout_s = self._timeout_s + volume_ml * self._s_per_ml
        reply = await self._ask("dose", f"{volume_ml:.3f}", timeout_s=timeout_s, condition=unknown)
        given_ml = self._number_in(reply, "dose")
        if abs(given_ml - volume_ml) > max(2 * SMALLEST_ML, 0.05 * volume_ml):
            raise DeviceError(DEVICE, "dose", f"gave {given_ml:.3f} ml instead of {volume_ml:.3f} ml")
        self._dosed_ml += volume_ml

    async def replenish(self, dips: int) -> Well:
        """Dose until the gauge shows `keep_level`. Raises `DoseLost` if a dose does not arrive, and as `dose` does."""
        level, dose_ml = await self.level(), self._config.dose_ml
        while level < self._config.keep_level:
            await self.dose(dose_ml)
            before, level = level, await self.level()
            if level < before + LEVEL_RISES:
                what = f"a dose of {dose_ml:g} ml left the well at {level:.0%} of its capacity"
                remedy = "Look at the tube, the reservoir and the gauge."
                raise DoseLost(DEVICE, "dose", what, condition="Nothing was dipped.", remedy=remedy)
        return Well(level, self._dosed_ml)

    async def light(self) -> float | None:
        """Set the light as the table says; return it, None if the table says nothing. Raises as `level` does."""
        if self._config.light is not None:
            await self._ask("light", f"{self._config.light:.3f}")
        return self._config.light

    async def level(self) -> float:
        """Fill level of the well, 0 to 1. Raises `InkRefused`, `DeviceError`."""
        level = self._number_in(await self._ask("level"), "level")
        if level > 1.0:
            raise ProtocolViolation(DEVICE, "level", f"level is {level:g}, above 1")
        return level

    async def close(self) -> None:
        """Close the port; light and lid stay as they are."""
        await self._port.close()

    async def _identify(self) -> Identity:
        reply = await self._ask("identify", attempts=self._connect_attempts)
        match reply.values:
            case (model, protocol, firmware, ("real" | "loopback") as kind) if (model, protocol) == (MODEL, PROTOCOL):
                return Identity(DEVICE, MODEL, firmware, kind == "loopback")
            case other:
                raise ProtocolViolation(
                    DEVICE,
                    "connect",
                    f"identifies as {' '.join(other)!r}, expected {MODEL} with protocol {PROTOCOL}",
                    remedy="Check that the path is that of the ink station, and its firmware.",
                )

    async def _ask(
        self, *words: str, timeout_s: float | None = None, attempts: int | None = None, condition: str = ""
    ) -> Reply:
        number, self._number = self._number, (self._number + 1) % NUMBERS
        request = seal(number, " ".join(words))
        left = attempts or self._attempts
        while True:
            try:
                reply = await self._port.exchange(
                    words[0],
                    request,
                    lambda received: find_reply(received, number),
                    timeout_s=timeout_s or self._timeout_s,
                    condition=condition,
                )
            except (DeviceTimeout, ProtocolViolation):
                left -= 1
                if not left:
                    raise
            else:
                break
        if reply.code:
            left_at = condition if reply.code == FAILED else "Nothing was done."
            remedy = REMEDIES.get(reply.code, "")
            raise InkRefused(DEVICE, words[0], reply.code, reply.text, condition=left_at, remedy=remedy)
        return reply

    def _number_in(self, reply: Reply, op: str) -> float:
        if len(reply.values) != 1:
            raise ProtocolViolation(DEVICE, op, f"expected one number, got {' '.join(reply.values)!r}")
        return number_of(reply.values[0])
