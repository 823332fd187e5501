"""Event loops in which time is simulated: no test waits, and what happens does not depend on how busy the machine is.

Time passes only while every task waits, and then jumps to the next timer.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import selectors
import socket
from collections.abc import Callable
from typing import Any, TypeVar

STEP_S = 1e-6
"""Time that passes at least between two looks at what is ready, so that a wait for the next moment ends."""

_R = TypeVar("_R")


class SimulatedTime:
    """The time of one loop, or of several one after the other; a `Clock`."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def now_ns(self) -> int:
        return round(1e9 * self.now_s)

    def seconds(self) -> float:
        return self.now_s

    def pass_s(self, seconds: float) -> None:
        self.now_s += seconds


class LoopClock:
    """A `Clock` that reads the running loop's time."""

    def now_ns(self) -> int:
        return round(1e9 * asyncio.get_running_loop().time())


class _Jumping(selectors.SelectSelector):
    """Instead of waiting, it lets simulated time pass."""

    def __init__(self, time: SimulatedTime, stands_still: Callable[[], bool]) -> None:
        super().__init__()
        self._time = time
        self._stands_still = stands_still

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        # The system is asked for signals and other threads only where every task waits: that takes time.
        ready = super().select(0.0) if timeout != 0.0 else []
        if not ready and timeout != 0.0:
            if self._stands_still():
                return []
            ready = super().select(None if timeout is None else 0.0)
        self._time.pass_s(STEP_S if ready or timeout is None else max(timeout, STEP_S))
        return ready


class MemoryLoop(asyncio.SelectorEventLoop):
    """Servers and their clients in this loop are connected in memory, and what a thread of an executor would do is done
    at once in the thread of the loop. Other threads and processes are not waited for."""

    def __init__(self, time: SimulatedTime | None = None, stands_still: Callable[[], bool] = lambda: False) -> None:
        """`stands_still` is asked whenever every task waits; where it is so no time passes, and the loop is to stop."""
        self.simulated = time or SimulatedTime()
        super().__init__(_Jumping(self.simulated, stands_still))
        self._servers: dict[tuple[str, int], MemoryServer] = {}
        # Each process has its own ports: an arm at one address has one driver on a machine, even if it is in memory.
        self._free_ports = itertools.count(10_000 + 4 * os.getpid() % 50_000)

    def time(self) -> float:
        return self.simulated.now_s

    def run_in_executor(self, executor: object, func: Callable[..., _R], *args: Any) -> asyncio.Future[_R]:  # type: ignore[override]
        future: asyncio.Future[_R] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    async def create_server(self, protocol_factory: Any, host: Any = None, port: Any = None, **_: Any) -> Any:  # type: ignore[override]
        address = host, port or next(self._free_ports)
        server = MemoryServer(self._servers, address, protocol_factory)
        assert self._servers.setdefault(address, server) is server, f"{address} is in use"
        return server

    async def create_connection(self, protocol_factory: Any, host: Any = None, port: Any = None, **_: Any) -> Any:  # type: ignore[override]
        if (server := self._servers.get((host, port))) is None:
            raise ConnectionRefusedError(f"nobody listens on {host}:{port} in this loop")
        near, far = socket.socketpair()
        await self.connect_accepted_socket(server.protocol_factory, far)
        return await super().create_connection(protocol_factory, sock=near)


class MemoryServer:
    """As much of an `asyncio.Server`, and of its socket, as a server of the loopback rig uses."""

    def __init__(self, servers: dict[tuple[str, int], MemoryServer], address: tuple[str, int], factory: Any) -> None:
        self.protocol_factory = factory
        self.sockets = [self]
        self._servers = servers
        self._address = address

    async def __aenter__(self) -> MemoryServer:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def getsockname(self) -> tuple[str, int]:
        return self._address

    def close(self) -> None:
        self._servers.pop(self._address, None)

    async def wait_closed(self) -> None:
        pass


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """The hook of a `conftest.py` in whose folder time is simulated."""
    return {"simulated": MemoryLoop}
