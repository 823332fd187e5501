"""Ink devices on serial lines in memory, in simulated time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from brushloop.drivers.ink import port, pump
from brushloop.drivers.ink.simulator import GARBAGE
from tests.simulated_time import MemoryLoop

PORT = "/dev/ttyUSB0"


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"simulated": MemoryLoop}


def loop() -> Any:
    return asyncio.get_running_loop()


class Script:
    """An instrument that knows its lines by heart; b"" as a reply is silence."""

    def __init__(self, exchanges: Sequence[tuple[bytes, bytes]]) -> None:
        self.left = list(exchanges)

    def take(self, buffer: bytearray) -> bytes | None:
        request = bytes(buffer)
        buffer.clear()
        return request or None

    def answer(self, request: bytes) -> bytes:
        assert self.left, f"nothing was expected, got {request!r}"
        expected, reply = self.left.pop(0)
        assert request == expected
        return reply


class Line:
    """As much of pyserial's `Serial` as the driver uses, over an instrument. Time passes while nothing is there."""

    def __init__(self, instrument: Any) -> None:
        self.instrument = instrument
        self.faults: list[str | None] = []
        """Of the next requests, one each: those of the loopback rig, or unplug."""
        self.requests = 0
        self.came = b""
        """What waits to be read."""
        self._request, self._late = bytearray(), b""

    @property
    def in_waiting(self) -> int:
        return len(self.came)

    def write(self, data: bytes) -> None:
        self.came, self._late = self.came + self._late, b""
        self._request += data
        while (request := self.instrument.take(self._request)) is not None:
            self.requests += 1
            fault = self.faults.pop(0) if self.faults else None
            if fault == "unplug":
                self.faults.append(fault)
                raise OSError(5, "Input/output error")
            reply = b"" if fault == "deaf" else self.instrument.answer(request) or b""
            if fault == "late":
                self._late = reply  # once the next request is on the line
            elif fault != "mute":
                self.came += GARBAGE if reply and fault == "garbage" else reply

    def read(self, size: int) -> bytes:
        taken, self.came = self.came[:size], self.came[size:]
        if not taken:
            loop().simulated.pass_s(port.POLL_S)
        return taken

    def close(self) -> None:
        pass


Plug = Callable[[Any], Line]


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Plug:
    """Puts an instrument at `PORT`, in place of the one before."""
    simulated = SimpleNamespace(monotonic=lambda: loop().time(), sleep=lambda seconds: loop().simulated.pass_s(seconds))
    monkeypatch.setattr(port, "time", simulated)
    monkeypatch.setattr(pump, "time", simulated)

    def put(instrument: Any) -> Line:
        line = Line(instrument)
        monkeypatch.setattr("serial.Serial", lambda *_, **__: line)
        return line

    return put


Scripted = Callable[..., None]


@pytest.fixture
def scripted(plug: Plug) -> Iterator[Scripted]:
    """Puts an instrument at `PORT` that expects these requests and nothing else until the test ends."""
    lines: list[Line] = []
    yield lambda *exchanges: lines.append(plug(Script(exchanges)))
    assert not (left := [line.instrument.left for line in lines if line.instrument.left]), f"never asked for: {left}"
