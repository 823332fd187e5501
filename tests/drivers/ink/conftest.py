"""A serial line that expects a transcript: these requests, answered by these replies, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

import pytest

from brushloop.drivers.ink.simulator import PtyLine

Transcript = Callable[[Sequence[tuple[bytes, bytes]]], AbstractContextManager[str]]


class Script:
    """An instrument that knows its lines by heart; b"" as a reply is silence."""

    def __init__(self, exchanges: Sequence[tuple[bytes, bytes]]) -> None:
        self.left = list(exchanges)
        self.surprises: list[str] = []

    def take(self, buffer: bytearray) -> bytes | None:
        size = len(self.left[0][0]) if self.left else 1
        if len(buffer) < size:
            return None
        request = bytes(buffer[:size])
        del buffer[:size]
        return request

    def answer(self, request: bytes) -> bytes | None:
        if not self.left:
            self.surprises.append(f"nobody expected {request!r}")
            return None
        expected, reply = self.left.pop(0)
        if request != expected:
            self.surprises.append(f"expected {expected!r}, got {request!r}")
        return reply

    def damage(self, reply: bytes) -> bytes:
        return reply

    def mistake(self, reply: bytes) -> bytes:
        return reply


@contextmanager
def play(exchanges: Sequence[tuple[bytes, bytes]]) -> Iterator[str]:
    script = Script(exchanges)
    with PtyLine(script) as line:
        yield line.path
    assert not script.surprises
    assert not script.left, f"never asked for: {script.left}"


@pytest.fixture
def expected_protocol() -> Transcript:
    """`with expected_protocol([(request, reply), ...]) as path:`; fails where anything is left unsent."""
    return play
