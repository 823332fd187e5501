"""SOF frames of ARCS: `53 4F 46`, a flag byte, a big-endian length, a payload.

| flag | length | who sends it |
|---|---|---|
| 0x01 | uint32 | the vendor's RPC client, always; this driver too |
| 0x00 | uint16 | the vendor's RTDE client |
"""

from __future__ import annotations

import struct

from drivers.errors import ProtocolViolation

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


class FrameDecoder:
    """Turns a byte stream, cut anywhere, into payloads."""

    def __init__(self, device: str = "arcs", *, skip: bytes = b"", max_bytes: int = MAX_PAYLOAD_BYTES) -> None:
        """`skip` is what may stand between frames and means nothing."""
        self._device = device
        self._skip = skip
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._broken: str | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """Payloads completed by `data`, in order.

        Raises `ProtocolViolation` where the stream is not SOF, and from then on always: nothing after it, nor of the
        same `data`, can be trusted.
        """
        if self._broken is not None:
            raise self._violation(self._broken)
        self._buffer += data
        payloads: list[bytes] = []
        while (payload := self._next()) is not None:
            payloads.append(payload)
        return payloads

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

    def _violation(self, what: str) -> ProtocolViolation:
        self._broken = what
        self._buffer.clear()
        return ProtocolViolation(self._device, "decode", what)
