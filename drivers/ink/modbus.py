"""The part of Modbus RTU that a pump needs: writing one register, and exceptions.

| frame | bytes |
|---|---|
| request | unit, 06, register (2, high first), value (2, high first), CRC (2, low first) |
| reply | the request again |
| exception | unit, 86, code, CRC (2, low first) |
"""

from __future__ import annotations

import struct

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink.port import crc16

DEVICE = "pump"
WRITE_REGISTER = 0x06
EXCEPTION_BIT = 0x80
WRITE_BYTES = 8
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


def unseal(frame: bytes) -> bytes:
    """The body of a frame. Raises `ProtocolViolation` if it is too short or the CRC is wrong."""
    if len(frame) < 4:
        raise ProtocolViolation(DEVICE, "decode", f"{len(frame)} bytes are not a frame")
    body = frame[:-2]
    if seal(body) != frame:
        raise ProtocolViolation(DEVICE, "decode", f"CRC of {frame.hex(' ')} should be {seal(body)[-2:].hex(' ')}")
    return body


def write_register(unit: int, register: int, value: int) -> bytes:
    """The request to write one register. Raises ValueError if a field does not fit."""
    if not (1 <= unit <= 247 and 0 <= register <= 0xFFFF and 0 <= value <= 0xFFFF):
        raise ValueError(f"unit {unit}, register {register}, value {value} do not fit a frame")
    return seal(struct.pack(">BBHH", unit, WRITE_REGISTER, register, value))


def exception(unit: int, function: int, code: int) -> bytes:
    """The exception reply of a unit that refuses a request."""
    return seal(bytes([unit, function | EXCEPTION_BIT, code]))


def read_write(frame: bytes) -> tuple[int, int, int]:
    """(unit, register, value) of a write request or its reply. Raises `ProtocolViolation`."""
    body = unseal(frame)
    if len(frame) != WRITE_BYTES or body[1] != WRITE_REGISTER:
        raise ProtocolViolation(DEVICE, "decode", f"{frame[:16].hex(' ')} does not write a register")
    unit, _, register, value = struct.unpack(">BBHH", body)
    return unit, register, value


def find_reply(received: bytes, request: bytes) -> int | None:
    """0 if `received` confirms `request`, the code if it is an exception, None while it is neither.

    Noise before the reply is skipped: the CRC decides where a frame is. Of two replies the one that ends first
    counts, so the result does not depend on how the bytes were split.
    """
    confirmed = received.find(request)
    before = received if confirmed < 0 else received[: confirmed + len(request) - 1]
    head = bytes([request[0], request[1] | EXCEPTION_BIT])
    start = before.find(head)
    while 0 <= start <= len(before) - EXCEPTION_BYTES:
        frame = before[start : start + EXCEPTION_BYTES]
        # Code 0 is not an exception, and would read as a confirmation.
        if seal(frame[:3]) == frame and frame[2]:
            return frame[2]
        start = before.find(head, start + 1)
    return None if confirmed < 0 else 0
