"""A TCP proxy in front of the controller that sees the wire: `python -m bench.proxy PORT`, in a process of its own.

It stamps each moveLine and stopLine when its socket has it, and holds back the reply of every moveLine, with all that
the controller says on that connection after it, until a line comes on its input. It tells its port first, then a line
`METHOD NANOSECONDS` for each; the clock is the machine's monotonic one, which all processes share.
"""

from __future__ import annotations

import asyncio
import sys
import time

from bench.processes import HOST, lines_of_input, tell

WATCHED = ("moveLine", "stopLine")


class Proxy:
    """Any number of connections, each with one of its own to the controller."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._flowing = asyncio.Event()
        self._flowing.set()

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carry bytes both ways until either end goes."""
        theirs, ours = await asyncio.open_connection(HOST, self._port)
        free = asyncio.Event()
        free.set()
        back = asyncio.create_task(self._back(theirs, writer, free))
        try:
            while data := await reader.read(65536):
                at_ns = time.monotonic_ns()
                # A client has one request outstanding and sends it in one piece.
                for name in WATCHED:
                    if name.encode() in data:
                        if name == "moveLine":
                            self._flowing.clear()
                            free.clear()
                        tell(f"{name} {at_ns}")
                ours.write(data)
        except ConnectionError:
            pass
        finally:
            back.cancel()
            ours.close()
            writer.close()

    async def _back(self, theirs: asyncio.StreamReader, writer: asyncio.StreamWriter, free: asyncio.Event) -> None:
        while data := await theirs.read(65536):
            if not free.is_set():
                await self._flowing.wait()
                free.set()
            writer.write(data)
        writer.close()

    def release(self) -> None:
        """Let go of what is held back."""
        self._flowing.set()


async def _serve(port: int) -> None:
    proxy = Proxy(port)
    server = await asyncio.start_server(proxy.converse, HOST, 0)
    questions = await lines_of_input()
    tell(str(server.sockets[0].getsockname()[1]))
    while await questions.readline():
        proxy.release()
        tell("released 0")
    server.close()


if __name__ == "__main__":
    asyncio.run(_serve(int(sys.argv[1])))
