"""Ink devices on serial lines in memory, in simulated time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from brushloop.drivers.ink import port, pump
from brushloop.drivers.ink.simulator import GARBAGE
from tests.rigs import MemoryLine
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


class Line(MemoryLine):
    """The line of an instrument, with faults. Time passes while nothing is there to be read."""

    def __init__(self, instrument: Any) -> None:
        super().__init__(instrument)
        self.faults: list[str | None] = []
        """Of the next requests, one each: those of the loopback rig, or unplug."""
        self.requests = 0
        self._late = b""

    def write(self, data: bytes) -> None:
        self.came, self._late = self.came + self._late, b""
        super().write(data)

    def read(self, size: int) -> bytes:
        if not self.came:
            loop().simulated.pass_s(port.POLL_S)
        return super().read(size)

    def _answered(self, request: bytes) -> bytes:
        self.requests += 1
        fault = self.faults.pop(0) if self.faults else None
        if fault == "unplug":
            self.faults.append(fault)
            raise OSError(5, "Input/output error")
        reply = b"" if fault == "deaf" else super()._answered(request)
        if fault == "late":
            self._late = reply  # comes once the next request is on the line
        return {"mute": b"", "late": b"", "garbage": GARBAGE}.get(fault or "", reply)


Plug = Callable[[Any], Line]


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Plug:
    """Puts an instrument at `PORT`, in place of the one before."""
    simulated = SimpleNamespace(monotonic=lambda: loop().time(), sleep=lambda seconds: loop().simulated.pass_s(seconds))
    monkeypatch.setattr(port, "time", simulated)
    monkeypatch.setattr(pump, "time", simulated)

    def put(instrument: Any) -> Line:
        line = Line(instrument)
        monkeypatch.setattr("serial.serial_for_url", lambda *_, **__: line)
        return line

    return put


Scripted = Callable[..., None]


@pytest.fixture
def scripted(plug: Plug) -> Iterator[Scripted]:
    """Puts an instrument at `PORT` that expects these requests and nothing else until the test ends."""
    lines: list[Line] = []
    yield lambda *exchanges: lines.append(plug(Script(exchanges)))
    assert not (left := [line.instrument.left for line in lines if line.instrument.left]), f"never asked for: {left}"
