"""Hostile bytes from a seed, and what every decoder of a stream is held to."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Sequence

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from brushloop.drivers.errors import ProtocolViolation

LEAST_INPUTS = 10_000
"""For each decoder, every time the suite runs."""
EXAMPLES = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
MANY = st.lists(st.binary(max_size=80), min_size=40, max_size=60)
"""One example of hypothesis carries many inputs: drawing them is dearer than decoding them."""

Decode = Callable[[bytes], list[bytes]]

_TELLING = (b"\0", b"\x7f", b"\x80", b"\xff", b"\n", b"\r", b" ", b'"', b"\\", b"{", b"}", b"[", b"]", b",", b":", b"*")
_NUMBERS = (
    b"NaN",
    b"Infinity",
    b"-Infinity",
    b"1e999",
    b"-1e999",
    b"1e-999",
    b"-0",
    b"9" * 400,
    b"0x1",
    b"1_0",
    b"true",
)
_LENGTHS = (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff", b"\x9b" + b"\xff" * 8, b"\x5b" + b"\x7f" * 8)
_NESTING = (b"[" * 70, b'{"a":' * 70, b"\x81" * 40, b"\xa1\x61a" * 20, b"]" * 70, b"\xd8\x23")


def mutated(valid: Sequence[bytes], count: int, seed: int) -> Iterator[bytes]:
    """`count` valid messages, each with one to four injuries."""
    rng = random.Random(seed)
    for _ in range(count):
        data = bytearray(rng.choice(valid))
        for _ in range(rng.randint(1, 4)):
            _injure(data, valid, rng)
        yield bytes(data)


def noise(count: int, seed: int, longest: int = 80) -> Iterator[bytes]:
    """`count` pieces of anything."""
    rng = random.Random(seed)
    return (rng.randbytes(rng.randint(0, longest)) for _ in range(count))


def truncated(valid: Iterable[bytes]) -> Iterator[bytes]:
    """Each message cut off at every byte."""
    return (message[:end] for message in valid for end in range(len(message)))


def bytewise(stream: bytes) -> list[bytes]:
    """Split at every boundary."""
    return [stream[at : at + 1] for at in range(len(stream))]


def pieces(stream: bytes, rng: random.Random) -> list[bytes]:
    """Split at a few boundaries."""
    cuts = sorted(rng.randint(0, len(stream)) for _ in range(rng.randint(0, 5)))
    return [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]


def decoded(feed: Decode, chunks: Iterable[bytes]) -> tuple[list[bytes], bool]:
    """What a decoder hands over until it refuses, and whether it did. Any error but the right one is raised."""
    found: list[bytes] = []
    for chunk in chunks:
        try:
            found += feed(chunk)
        except ProtocolViolation:
            return found, True
    return found, False


def holds_for_every_cut(new: Callable[[], Decode], stream: bytes, rng: random.Random) -> bool:
    """Check one stream in one piece, in a few, and byte by byte; whether it was taken as valid.

    A piece that holds a violation hands nothing over, so what came before it shows only in smaller pieces.
    """
    finest, refused = decoded(new(), bytewise(stream))
    for chunks in ([stream], pieces(stream, rng)):
        found, refused_too = decoded(new(), chunks)
        assert refused_too == refused, stream
        assert found == (finest[: len(found)] if refused else finest), stream
    return not refused


def _injure(data: bytearray, valid: Sequence[bytes], rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    end = min(len(data), at + rng.randint(1, 8))
    match rng.randrange(10):
        case 0 if data:
            data[min(at, len(data) - 1)] ^= 1 << rng.randrange(8)
        case 1:
            data[at:end] = b""
        case 2:
            data[at:at] = data[at:end] * rng.randint(1, 3)
        case 3:
            data[at:at] = rng.randbytes(rng.randint(1, 8))
        case 4:
            del data[at:]
        case 5:
            data[at:] = rng.choice(valid)[rng.randint(0, at) :]
        case 6:
            data[at:end] = rng.choice(_LENGTHS)
        case 7:
            data[at:end] = rng.choice(_NUMBERS)
        case 8:
            data[at:at] = rng.choice(_NESTING)
        case _:
            data[at:end] = rng.choice(_TELLING)
