"""The loopback rig: started in a process of its own and asked from outside, and the base of its servers.

A simulator needs an interpreter of its own: it keeps real time while the process that uses it computes. It also holds
the simulated sheet, and the rig of a demo outlives the demo, so it is started as the command that serves it.
"""

import asyncio
import contextlib
import ipaddress
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from brushloop.drivers.errors import ProtocolViolation

START_S = 120.0
"""Longest start; a busy machine may need most of it."""
POLL_S = 0.05
RATE = 30.0


class RigRefused(Exception):
    """The loopback rig did not start, or cannot do what it was asked: says which file, field, socket or request."""

    exit_code: ClassVar[int] = 2


@dataclass(frozen=True, slots=True)
class LoopbackRig:
    """A loopback rig that serves; nothing that it presses is a result on paper."""

    config: Path
    """Its rig.toml."""
    process: subprocess.Popen[bytes]

    def fresh_sheet(self) -> None:
        """Put a blank sheet in."""
        self.process.send_signal(signal.SIGUSR1)

    def end(self) -> None:
        """End the rig and wait for it."""
        self.process.terminate()
        self.process.wait()


def start(config: Path, log: Path, *options: str, detached: bool = False) -> LoopbackRig:
    """Start `brushloop sim` and wait until it has written `config`, which must not exist yet.

    Detached, it is not reached by Ctrl-C in this terminal. Raises `RigRefused`, with what it printed.
    """
    command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(config), *options]
    with log.open("ab") as file:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=detached
        )
    rig = LoopbackRig(config, process)
    deadline = time.monotonic() + START_S
    while not config.exists():
        if process.poll() is not None or time.monotonic() > deadline:
            rig.end()
            raise RigRefused(f"the loopback rig did not start; {log} says: {log.read_text(errors='replace')}")
        time.sleep(POLL_S)
    return rig


@contextlib.contextmanager
def simulate(folder: Path, *, rate: float = RATE, brush: str = "loopback") -> Generator[LoopbackRig]:
    """Serve a loopback rig until the end of the block, `rate` simulated seconds in a real one.

    Its files are kept in `folder`. `brush` as for `brushloop sim`. Raises `RigRefused`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    config = folder.resolve() / "rig.toml"
    config.unlink(missing_ok=True)  # that of an earlier rig, which no longer serves
    rig = start(config, folder / "rig.log", "--rate", str(rate), "--brush", brush)
    try:
        yield rig
    finally:
        rig.end()


ANSWER_S = 120.0
"""Longest wait for an answer: a person in the lab may have to act first."""


def ask(path: Path, request: Mapping[str, object]) -> dict[str, Any]:
    """Send a request; return the rig's answer. Raises `RigRefused` if it is missing or a refusal."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(ANSWER_S)
            client.connect(str(path))
            client.sendall(json.dumps(request).encode() + b"\n")
            answer: Any = json.loads(client.makefile("rb").readline())
    except OSError as error:
        raise RigRefused(f"{path}: no rig answers here: {error.strerror or error}") from None
    except (ValueError, RecursionError):
        answer = None
    match answer:
        case {"ok": True, **rest}:
            return rest  # pyright: ignore[reportUnknownVariableType]
        case {"ok": False, "error": str(error)}:
            raise RigRefused(error)
        case _:
            raise RigRefused(f"{path}: not the control socket of a rig")


ENDS_OF_A_CLIENT = (
    *(ConnectionError, TimeoutError, asyncio.IncompleteReadError),  # it disconnected
    *(ProtocolViolation, ValueError, asyncio.LimitOverrunError),  # it does not speak the protocol
    asyncio.CancelledError,  # `stop`: the streams module would report a cancelled handler as an error
)


class LoopbackServer:
    """A TCP server whose clients are tasks; `converse` speaks to one of them."""

    def __init__(self) -> None:
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self.port = 0

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one client until it disconnects; may raise connection errors. This one only listens, never answers."""
        while await reader.read(4096):
            pass

    async def start(self, host: str, port: int) -> None:
        """Listen; with `port` 0 the system chooses `self.port`.

        Raises ValueError unless `host` is a loopback address, so that no other machine can reach a simulated device; a
        host name could resolve to any address.
        """
        if not ipaddress.ip_address(host).is_loopback:
            raise ValueError(f"host = {host!r}: a loopback rig is served on a loopback address only, such as 127.0.0.1")
        self._server = await asyncio.start_server(self._serve, host, port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Close the listener and every client."""
        server, self._server = self._server, None
        if server is not None:
            # asyncio leaves a connection open that is accepted in the turn of the loop in which the server closes.
            await asyncio.sleep(0)
            server.close()
            for _ in range(3):  # from accepting a connection to the first step of its task
                await asyncio.sleep(0)
            self.drop_clients()
            await asyncio.gather(*self._clients, return_exceptions=True)
            await server.wait_closed()

    def drop_clients(self) -> None:
        """Close every connection from the server's side."""
        for task in list(self._clients):
            task.cancel()

    @staticmethod
    def write(writer: asyncio.StreamWriter, data: bytes) -> None:
        """Send to a client, unless it has gone."""
        if not writer.is_closing():
            writer.write(data)

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            with contextlib.suppress(*ENDS_OF_A_CLIENT):
                await self.converse(reader, writer)
        finally:
            self._clients.discard(task)
            writer.close()
            with contextlib.suppress(ConnectionError, asyncio.CancelledError):
                await writer.wait_closed()
