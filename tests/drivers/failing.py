"""Faults without a rig: for a simulated instrument, for one that follows a script, and for a silent controller."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.ink.simulator import PtyLine
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault


@dataclass
class SetClock:
    """A clock that a test sets."""

    s: float = 0.0

    def now_ns(self) -> int:
        return round(1e9 * self.s)


class PatientClock:
    """The time of the serial port: it stands still until a request is not answered as it should be."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def monotonic(self) -> float:
        return self._now_s

    def sleep(self, _seconds: float) -> None:
        pass

    def jump_soon(self) -> None:
        """Let the time for the present request run out, once bytes that are on their way have arrived."""
        asyncio.get_running_loop().call_later(0.1, self._jump)

    def _jump(self) -> None:
        self._now_s += 1000.0


class PatientLine(PtyLine):
    """The line of an instrument, on which the time of a request runs out where it is not answered as it should be."""

    clock = PatientClock()

    def __init__(self, instrument: Any) -> None:
        super().__init__(instrument)
        self._answer, instrument.answer = instrument.answer, self._answered

    def _answered(self, request: bytes) -> bytes | None:
        reply = self._answer(request)
        if not reply:
            self.clock.jump_soon()
        return reply

    def fail(self, *faults: str | None) -> None:
        """Apply these faults to the next requests, one each."""
        coming = iter(faults)

        def next_fault() -> str | None:
            fault = next(coming, None)
            if fault not in (None, "unplug"):
                self.clock.jump_soon()
            return fault

        self.next_fault = next_fault


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
        expected, reply = self.left.pop(0) if self.left else (b"", b"")
        if request != expected:
            self.surprises.append(f"expected {expected!r}, got {request!r}")
        return reply


@contextmanager
def scripted(*exchanges: tuple[bytes, bytes]) -> Iterator[str]:
    """The port of an instrument that expects these requests and nothing else."""
    script = Script(exchanges)
    with PatientLine(script) as line:
        yield line.path
    assert not script.surprises
    assert not script.left, f"never asked for: {script.left}"


def cut(connection: RpcConnection) -> None:
    """End the connection from this side, as a pulled cable does."""
    assert connection._stream is not None
    connection._stream[1].transport.abort()


def mute(server: ArcsServer | RtdeServer) -> None:
    """Requests are neither carried out nor answered; nothing is pushed."""
    if isinstance(server, RtdeServer):
        server.faults.hang(Fault(device=Device.TELEMETRY, kind="mute", count=ALWAYS))
    else:
        server.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))


def mute_to(server: ArcsServer, method: str) -> None:
    """Requests of this method are carried out, but never answered."""
    server.faults.hang(Fault(device=Device.ROBOT, kind="mute", on=method, count=ALWAYS))
