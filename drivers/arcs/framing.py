"""What goes over the wire of ARCS: SOF frames, bare JSON documents, and lists of numbers within either.

A SOF frame is `53 4F 46`, a flag byte, a big-endian length, a payload:

| flag | length | who sends it |
|---|---|---|
| 0x01 | uint32 | the maker's RPC client, always; this driver too |
| 0x00 | uint16 | the maker's RTDE client |

Bare JSON is one document after another, with nothing between them and no newline at the end. The end of a document is
found by its brackets: parsing again and again until it succeeds would take quadratic time on a reply that comes in
small pieces, and could not tell a reply that is cut off from one that is wrong.
"""

from __future__ import annotations

import abc
import json
import math
import re
import struct

from brushloop.drivers.errors import ProtocolViolation

MAGIC = b"SOF"
FLAG_LONG = 0x01
FLAG_SHORT = 0x00
MAX_PAYLOAD_BYTES = 16 * 1024 * 1024
"""Far above any reply of a controller; a hostile length must not make the host allocate gigabytes."""


def encode_short(payload: bytes) -> bytes:
    """One frame with a 16-bit length, as RTDE uses. Raises ValueError where the payload does not fit."""
    if len(payload) > 0xFFFF:
        raise ValueError(f"payload of {len(payload)} bytes exceeds 65535")
    return MAGIC + bytes([FLAG_SHORT]) + struct.pack(">H", len(payload)) + payload


def encode(payload: bytes) -> bytes:
    """One frame with a 32-bit length. Raises ValueError above `MAX_PAYLOAD_BYTES`."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload of {len(payload)} bytes exceeds {MAX_PAYLOAD_BYTES}")
    return MAGIC + bytes([FLAG_LONG]) + struct.pack(">I", len(payload)) + payload


class _Decoder(abc.ABC):
    """Turns a byte stream, split at any point, into what `_next` finds at its beginning."""

    def __init__(self, device: str, max_bytes: int) -> None:
        self._device = device
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._broken: str | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """What `data` completes, in order.

        Raises `ProtocolViolation` for bytes outside the format, and then on every later call: neither this `data` nor
        anything after it can be trusted.
        """
        if self._broken is not None:
            raise self._violation(self._broken)
        self._buffer += data
        found: list[bytes] = []
        while (one := self._next()) is not None:
            found.append(one)
        return found

    @abc.abstractmethod
    def _next(self) -> bytes | None:
        """Take the next whole item from the buffer; None while it is incomplete."""

    def _violation(self, what: str) -> ProtocolViolation:
        self._broken = what
        self._buffer.clear()
        return ProtocolViolation(self._device, "decode", what)


class FrameDecoder(_Decoder):
    """Turns a byte stream, split at any point, into the payloads of SOF frames."""

    def __init__(self, device: str = "arcs", *, skip: bytes = b"", max_bytes: int = MAX_PAYLOAD_BYTES) -> None:
        """`skip` holds bytes that may appear between frames and are ignored."""
        super().__init__(device, max_bytes)
        self._skip = skip

    def _next(self) -> bytes | None:
        buffer, skip = self._buffer, self._skip
        while skip and buffer.startswith(skip):
            del buffer[: len(skip)]
        if 0 < len(buffer) < len(skip) and skip.startswith(bytes(buffer)):
            return None
        if not MAGIC.startswith(bytes(buffer[:3])):
            raise self._violation(f"expected SOF, got {bytes(buffer[:8])!r}")
        if len(buffer) < 4:
            return None
        match buffer[3]:
            case 0x01:
                head, size = 8, struct.unpack_from(">I", buffer, 4)[0] if len(buffer) >= 8 else None
            case 0x00:
                head, size = 6, struct.unpack_from(">H", buffer, 4)[0] if len(buffer) >= 6 else None
            case flag:
                raise self._violation(f"unknown SOF flag {flag:#04x}")
        if size is None:
            return None
        if size > self._max_bytes:
            raise self._violation(f"frame of {size} bytes exceeds {self._max_bytes}")
        if len(buffer) < head + size:
            return None
        payload = bytes(buffer[head : head + size])
        del buffer[: head + size]
        return payload


MAX_DOCUMENT_BYTES = 1024 * 1024
"""Far above any reply of a controller."""
MAX_DEPTH = 64
"""No reply nests deeper than five; the parser must not run out of stack."""

_STRUCTURE = re.compile(rb'["{}\[\]]')
_STRING_END = re.compile(rb'["\\]')
_CLOSES = {ord("}"): ord("{"), ord("]"): ord("[")}


class BareDecoder(_Decoder):
    """Turns a byte stream, split at any point, into JSON documents, bounded in size and depth.

    NaN and Infinity are accepted, as by Python's `json`.
    """

    def __init__(self, device: str = "arcs", *, max_bytes: int = MAX_DOCUMENT_BYTES) -> None:
        super().__init__(device, max_bytes)
        self._at = 0
        self._open: list[int] = []
        self._in_string = False

    def _next(self) -> bytes | None:
        if not self._open:
            del self._buffer[: len(self._buffer) - len(self._buffer.lstrip(b" \t\r\n"))]
            if self._buffer and self._buffer[0] not in b"{[":
                raise self._violation(f"expected JSON, got {bytes(self._buffer[:8])!r}")
        end = self._scan()
        if (end or len(self._buffer)) > self._max_bytes:
            raise self._violation(f"document exceeds {self._max_bytes} bytes")
        if end is None:
            return None
        document = bytes(self._buffer[:end])
        del self._buffer[:end]
        self._at = 0
        try:
            json.loads(document)
        except (ValueError, RecursionError):
            raise self._violation(f"not JSON: {document[:40]!r}") from None
        return document

    def _scan(self) -> int | None:
        """Continue where the last piece ended; return the end of the document, or None if it has not arrived."""
        buffer = self._buffer
        while True:
            found = (_STRING_END if self._in_string else _STRUCTURE).search(buffer, self._at)
            if found is None:
                self._at = len(buffer)
                return None
            byte, self._at = buffer[found.start()], found.end()
            if byte == ord("\\"):
                if self._at == len(buffer):  # the escaped character has not arrived: scan again from here
                    self._at -= 1
                    return None
                self._at += 1
            elif byte == ord('"'):
                self._in_string = not self._in_string
            elif byte in _CLOSES:
                if self._open.pop() != _CLOSES[byte]:
                    raise self._violation("brackets do not match")
                if not self._open:
                    return self._at
            else:
                self._open.append(byte)
                if len(self._open) > MAX_DEPTH:
                    raise self._violation(f"nested deeper than {MAX_DEPTH}")


def numbers(values: object, count: int) -> list[float]:
    """`values` as floats. Raises ValueError unless it is a list of `count` finite numbers.

    JSON allows integers too large for a float, and a string of six digits is not a pose.
    """
    if not isinstance(values, list):
        raise ValueError(f"expected {count} numbers, got {str(values)[:80]!r}")
    try:
        found = [float(v) if type(v) in (int, float) else math.nan for v in values]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    except OverflowError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise ValueError(f"expected {count} finite numbers, got {str(values)[:80]}")  # pyright: ignore[reportUnknownArgumentType]
    return found
