"""Faults without a rig: for a simulated instrument, for one that follows a script, and for a silent controller."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from brushloop.drivers.force.simulator import ForceBoard
from brushloop.drivers.ink.simulator import PtyLine
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault


def fail_rounds(board: ForceBoard, *faults: str) -> None:
    """Apply these faults to the board's next rounds, one each."""
    coming = iter(faults)
    board.next_fault = lambda: next(coming, None)


def fail_requests(line: PtyLine, *faults: str) -> None:
    """Apply these faults to the next requests on the line, one each."""
    coming = iter(faults)
    line.next_fault = lambda: next(coming, None)


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

    def damage(self, reply: bytes) -> bytes:
        return reply

    def mistake(self, reply: bytes) -> bytes:
        return reply


@contextmanager
def scripted(exchanges: Sequence[tuple[bytes, bytes]]) -> Iterator[str]:
    """The port of an instrument that expects these requests and nothing else."""
    script = Script(exchanges)
    with PtyLine(script) as line:
        yield line.path
    assert not script.surprises
    assert not script.left, f"never asked for: {script.left}"


def mute(server: ArcsServer | RtdeServer) -> None:
    """Requests are neither carried out nor answered; nothing is pushed."""
    if isinstance(server, RtdeServer):
        server.faults.hang(Fault(device=Device.TELEMETRY, kind="mute", count=ALWAYS))
    else:
        server.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))


def mute_to(server: ArcsServer, method: str) -> None:
    """Requests of this method are carried out, but never answered."""
    server.faults.hang(Fault(device=Device.ROBOT, kind="mute", on=method, count=ALWAYS))
