"""Ink devices on serial lines in memory, in simulated time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from brushloop.drivers.ink import port, pump
from brushloop.drivers.ink.simulator import GARBAGE
from tests.rigs import MemoryLine
from tests.simulated_time import pytest_asyncio_loop_factories as pytest_asyncio_loop_factories

PORT = "/dev/ttyUSB0"


def loop() -> Any:
    return asyncio.get_running_loop()


class Line(MemoryLine):
    """The line of an instrument, with faults. Time passes while nothing is there to be read."""

    def __init__(self, instrument: Any) -> None:
        super().__init__(instrument)
        self.faults: list[str | bytes | None] = []
        """Of the next requests, one each: those of the loopback rig, or what comes instead of the reply."""
        self.requests: list[bytes] = []
        self._late = b""

    def write(self, data: bytes) -> None:
        self.came, self._late = self.came + self._late, b""
        super().write(data)

    def read(self, size: int) -> bytes:
        if not self.came:
            loop().simulated.pass_s(port.POLL_S)
        return super().read(size)

    def _answered(self, request: bytes) -> bytes:
        self.requests.append(request)
        fault = self.faults.pop(0) if self.faults else None
        if fault == "unplug":
            self.faults.append(fault)
            raise OSError(5, "Input/output error")
        reply = b"" if fault == "deaf" else super()._answered(request)
        if fault == "late":
            self._late = reply  # comes once the next request is on the line
        if isinstance(fault, bytes):
            return fault
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
