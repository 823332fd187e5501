"""Faults without a rig: for a simulated instrument, and for a controller that falls silent."""

from __future__ import annotations

from brushloop.drivers.force.simulator import ForceBoard
from brushloop.drivers.ink.simulator import PtyLine
from brushloop.drivers.sim.arcs.server import ArcsServer, RtdeServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault


def fail_rounds(board: ForceBoard, *faults: str) -> None:
    """Apply these faults to the board's next rounds, one each."""
    coming = iter(faults)
    board.next_fault = lambda: next(coming, None)


def fail_requests(line: PtyLine, *faults: str) -> None:
    """Apply these faults to the next requests on the line, one each."""
    coming = iter(faults)
    line.next_fault = lambda: next(coming, None)


def mute(server: ArcsServer | RtdeServer) -> None:
    """Requests are neither carried out nor answered; nothing is pushed."""
    if isinstance(server, RtdeServer):
        server.faults.hang(Fault(device=Device.TELEMETRY, kind="mute", count=ALWAYS))
    else:
        server.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))


def mute_to(server: ArcsServer, method: str) -> None:
    """Requests of this method are carried out, but never answered."""
    server.faults.hang(Fault(device=Device.ROBOT, kind="mute", on=method, count=ALWAYS))
