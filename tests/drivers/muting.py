"""Loopback servers that fall silent until `server.faults.clear()`."""

from __future__ import annotations

from brushloop.drivers.sim.arcs.server import ArcsServer, RtdeServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault


def mute(server: ArcsServer | RtdeServer) -> None:
    """Requests are neither carried out nor answered; nothing is pushed."""
    if isinstance(server, RtdeServer):
        server.faults.hang(Fault(device=Device.TELEMETRY, kind="mute", count=ALWAYS))
    else:
        server.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))


def mute_to(server: ArcsServer, method: str) -> None:
    """Requests of this method are carried out, but never answered."""
    server.faults.hang(Fault(device=Device.ROBOT, kind="mute", on=method, count=ALWAYS))
