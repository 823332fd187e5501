"""Base of the loopback servers: a listener, its clients, and a clean end."""

from __future__ import annotations

import abc
import asyncio
import contextlib
import ipaddress
from typing import ClassVar

from brushloop.drivers.errors import ProtocolViolation

TURNS_TO_BEGIN = 3
"""Turns of the event loop from accepting a connection to the first step of its task."""


class NotLoopback(ValueError):
    """A simulated device was asked to listen where other machines could reach it."""

    exit_code: ClassVar[int] = 2

    def __init__(self, host: str) -> None:
        self.host = host
        super().__init__(f"host = {host!r}: a loopback rig is served on a loopback address only, such as 127.0.0.1")


class LoopbackServer(abc.ABC):
    """A TCP server whose clients are tasks; `converse` speaks to one of them."""

    def __init__(self) -> None:
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self.port = 0

    @abc.abstractmethod
    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one client until it disconnects; may raise connection errors."""

    async def start(self, host: str, port: int) -> None:
        """Listen; with `port` 0 the system chooses `self.port`.

        Raises `NotLoopback` unless `host` is a loopback address; a host name could resolve to any address.
        """
        if not _is_loopback(host):
            raise NotLoopback(host)
        self._server = await asyncio.start_server(self._serve, host, port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Close the listener and every client."""
        server, self._server = self._server, None
        if server is not None:
            # asyncio leaves a connection open that is accepted in the turn of the loop in which the server closes.
            await asyncio.sleep(0)
            server.close()
            for _ in range(TURNS_TO_BEGIN):
                await asyncio.sleep(0)
            self.drop_clients()
            await asyncio.gather(*self._clients, return_exceptions=True)
            await server.wait_closed()

    def drop_clients(self) -> None:
        """Close every connection from the server's side."""
        for task in list(self._clients):
            task.cancel()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            await self.converse(reader, writer)
        except (ConnectionError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client disconnected
        except ProtocolViolation:
            pass  # the client does not speak the protocol
        except asyncio.CancelledError:
            pass  # `stop`: the streams module would report a cancelled handler as an error
        finally:
            self._clients.discard(task)
            writer.close()
            with contextlib.suppress(ConnectionError, asyncio.CancelledError):
                await writer.wait_closed()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
