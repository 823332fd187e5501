"""No simulated device can be reached from another machine."""

from __future__ import annotations

import asyncio

import pytest

from brushloop.drivers.sim.arcs.server import ArcsServer, RtdeServer
from brushloop.drivers.sim.camera.mjpeg_server import MjpegServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.control import ControlServer
from brushloop.drivers.sim.instruments.force_board import SocketcandServer
from brushloop.drivers.sim.lab.lab import OlderSoftware
from brushloop.drivers.sim.server import LoopbackServer, NotLoopback
from brushloop.drivers.sim.world import World

ELSEWHERE = ["0.0.0.0", "::", "", "192.168.1.10", "10.0.0.1", "8.8.8.8", "example.org", "localhost", "fe80::1"]


def without_a_network(kind: type[LoopbackServer]) -> LoopbackServer:
    server = kind.__new__(kind)
    LoopbackServer.__init__(server)
    return server


def test_these_are_all_the_servers_there_are():
    def below(kind: type[LoopbackServer]) -> set[type[LoopbackServer]]:
        return {kind, *(b for k in kind.__subclasses__() for b in below(k))}

    ours = {k for k in below(LoopbackServer) if k.__module__.startswith("brushloop.drivers.")} - {LoopbackServer}
    assert ours == {ArcsServer, RtdeServer, MjpegServer, ControlServer, SocketcandServer, OlderSoftware}
    assert all(k.start is LoopbackServer.start for k in ours), "a server that listens in its own way must refuse too"


@pytest.mark.parametrize("kind", [ArcsServer, RtdeServer, MjpegServer, ControlServer, SocketcandServer])
@pytest.mark.parametrize("host", ELSEWHERE)
async def test_a_server_refuses_any_address_that_is_not_loopback(kind: type[LoopbackServer], host: str):
    server = without_a_network(kind)
    with pytest.raises(NotLoopback) as caught:
        await server.start(host, 0)
    assert caught.value.host == host
    assert caught.value.exit_code == 2
    assert server._server is None


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2"])
async def test_a_loopback_address_is_served(host: str):
    server = ArcsServer(World(SimConfig()))
    await server.start(host, 0)
    _, writer = await asyncio.open_connection(host, server.port)
    writer.close()
    await writer.wait_closed()
    await server.stop()
