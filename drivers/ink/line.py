"""The lines of the ink station: `NNN words*CRC`, ASCII, ended by a line feed; see docs/ink-station.md."""

from __future__ import annotations

import re
from dataclasses import dataclass

from drivers.errors import ProtocolViolation
from drivers.ink.crc import crc16

DEVICE = "ink"
MAX_LINE_BYTES = 96
NUMBERS = 1000
_SEALED = re.compile(rb"([0-9]{3}) ([ -)+-~]*)\*([0-9A-F]{4})\r?\n?", re.ASCII)
_REFUSAL = re.compile(r"err ([0-9]{1,3})(?: (.*))?")
_NUMBER = re.compile(r"[0-9]{1,6}(\.[0-9]{1,6})?")


@dataclass(frozen=True, slots=True)
class Line:
    """A sound line: its sequence number and what it says."""

    number: int
    text: str


@dataclass(frozen=True, slots=True)
class Reply:
    """`ok` with its values, or `err` with `code` above zero and a text."""

    values: tuple[str, ...] = ()
    code: int = 0
    text: str = ""


def seal(number: int, text: str) -> bytes:
    """A line as it goes over the wire. Raises ValueError where it would not be a line."""
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
    """The first whole reply to request `number`; None while there is none.

    Noise, echoes, damaged lines and replies to other requests are passed over: the sender asks again in time.
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
