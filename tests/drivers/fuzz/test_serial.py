"""What comes over the two serial lines: a reply, or nothing, and never another one for being cut differently."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from typing import TypeVar

import pytest
from hypothesis import given

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink import pump as modbus
from brushloop.drivers.ink import station as line
from tests.drivers.fuzz.inputs import EXAMPLES, LEAST_INPUTS, MANY, bytewise, mutated, noise, pieces, truncated

T = TypeVar("T")

LINES = [
    line.seal(5, text) for text in ("ok", "ok 0.730 1.250", "err 4 reservoir is empty", "ok nan inf 1e999", "hello")
]
LINES += [LINES[0] + LINES[1], b"\r\n" + LINES[2], line.seal(4, "ok 1.0") + LINES[1]]
START = modbus.write_register(1, 4, 1)
FRAMES = [START, modbus.exception(1, 6, 4), modbus.write_register(1, 1, 6000), modbus.exception(2, 6, 1)]
FRAMES += [FRAMES[1] + START, START + FRAMES[1], FRAMES[2] + START]


def first_found(find: Callable[[bytes], T | None], chunks: list[bytes]) -> T | None:
    """As `SerialPort` asks: everything so far is shown after each piece, until something is made of it."""
    received = b""
    for chunk in chunks:
        received += chunk
        if (found := find(received)) is not None:
            return found
    return None


def same_in_any_pieces(find: Callable[[bytes], T | None], received: bytes, rng: random.Random) -> T | None:
    """What is found, which must not depend on where the line was cut."""
    whole = find(received)
    assert first_found(find, bytewise(received)) == whole, received
    assert first_found(find, pieces(received, rng)) == whole, received
    return whole


def find_line(received: bytes) -> line.Reply | None:
    return line.find_reply(received, 5)


def find_frame(received: bytes) -> int | None:
    return modbus.find_reply(received, START)


def resealed(seed: int) -> list[bytes]:
    """Sound checksums around anything."""
    bodies = list(noise(1500, seed, longest=8))
    printable = [bytes(32 + byte % 95 for byte in body) for body in bodies]
    return [modbus.seal(body) for body in bodies] + [
        line.seal(5, text.decode()) for text in printable if b"*" not in text
    ]


@pytest.mark.parametrize(("find", "valid"), [(find_line, LINES), (find_frame, FRAMES)], ids=["ink station", "pump"])
def test_any_bytes_hold_one_reply_or_none(find: Callable[[bytes], object], valid: list[bytes]):
    rng = random.Random(31)
    inputs = found = 0

    @EXAMPLES
    @given(MANY)
    def anything(received: list[bytes]) -> None:
        nonlocal inputs
        for before in received:
            find(before + valid[0])
            same_in_any_pieces(find, before[:12], rng)
            inputs += 2

    anything()
    for received in [
        *truncated(valid),
        *mutated(valid, 4000, seed=31),
        *noise(500, seed=32, longest=40),
        *resealed(33),
    ]:
        found += same_in_any_pieces(find, received, rng) is not None
        inputs += 1
    assert inputs >= LEAST_INPUTS
    assert found > 200


def test_an_exception_that_comes_before_a_confirmation_counts_however_they_arrive():
    refused, confirmed = modbus.exception(1, 6, 4), START
    assert same_in_any_pieces(find_frame, refused + confirmed, random.Random(1)) == 4
    assert same_in_any_pieces(find_frame, confirmed + refused, random.Random(1)) == 0


def test_any_bytes_are_a_line_a_frame_a_number_or_a_violation():
    inputs = 0
    for data in [*mutated(LINES + FRAMES, 8000, seed=34), *noise(1000, seed=35), *resealed(36)]:
        for read in (line.unseal, modbus.unseal, modbus.read_write, lambda raw: line.number_of(raw.decode("latin-1"))):
            with contextlib.suppress(ProtocolViolation):
                read(data)
        inputs += 1
    assert inputs >= LEAST_INPUTS


@pytest.mark.parametrize(
    "flood", [b"\n" * 4096, b"\x01\x86" * 2048, START[:-1] * 585, LINES[0][:-1] * 300, b"*" * 4096]
)
def test_a_full_buffer_of_noise_is_looked_through_quickly(flood: bytes):
    assert find_line(flood) is None
    assert find_frame(flood) is None
