"""The force board behind a CAN gateway: the ASCII protocol of socketcand over TCP, as python-can's client speaks it.

| from the client | from the gateway |
|---|---|
| | `< hi >` on connecting |
| `< open NAME >` | `< ok >`, or `< error could not open bus >` |
| `< rawmode >` | `< ok >`, and from then on every frame of the bus |
| `< send ID LENGTH BYTE BYTE ... >` | nothing; the frame is put on the bus |
| | `< frame ID SECONDS HEX >`, `< error ID SECONDS >` |
"""

from __future__ import annotations

import asyncio
import time

from drivers.errors import ProtocolViolation
from drivers.force.samples import LOOPBACK_CHANNEL
from drivers.sim.brush.reaction import Reaction
from drivers.sim.clock import SimClock
from drivers.sim.instruments.force_board import CanFrame, ForceBoard
from drivers.sim.server import LoopbackServer

MAX_LINE_BYTES = 256
BACKLOG_BYTES = 32 * 1024
"""A client that does not read is sent nothing more until it has caught up."""


class SocketcandServer(LoopbackServer):
    """One board on one bus, for any number of clients."""

    def __init__(self, board: ForceBoard, clock: SimClock, reaction: Reaction, *, rate_hz: float) -> None:
        super().__init__()
        self.board = board
        self._clock = clock
        self._reaction = reaction
        self._period_s = 1.0 / rate_hz
        self._listeners: set[asyncio.StreamWriter] = set()
        self._streaming: asyncio.Task[None] | None = None
        self._preparing: asyncio.Task[None] | None = None

    async def stop(self) -> None:
        """Close the listener and every client, and end the stream."""
        await super().stop()
        if self._preparing is not None:
            await self._preparing
        if self._streaming is not None:
            self._streaming.cancel()
            await asyncio.gather(self._streaming, return_exceptions=True)
            self._streaming = None

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Greet, then carry frames both ways until the client goes."""
        prepared = self._preparing or asyncio.create_task(asyncio.to_thread(self._reaction.prepare), name="force table")
        self._preparing = prepared
        writer.write(b"< hi >")
        try:
            while True:
                words = (await _command(reader)).split(" ")
                match words:
                    case ["open", name]:
                        writer.write(b"< ok >" if name == LOOPBACK_CHANNEL else b"< error could not open bus >")
                    case ["rawmode"]:
                        await asyncio.shield(prepared)
                        writer.write(b"< ok >")
                        self._listeners.add(writer)
                    case ["send", can_id, length, *data]:
                        await self._sent(_frame(can_id, length, data))
                    case _:
                        writer.write(b"< error unknown command >")
                await writer.drain()
        finally:
            self._listeners.discard(writer)

    async def _sent(self, frame: CanFrame) -> None:
        self.board.obey(frame)
        if self._streaming is None or self._streaming.done():
            self._streaming = asyncio.create_task(self._stream(), name="force rounds")

    async def _stream(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while self.board.streaming and self._listeners:
            text = "".join(_ascii(frame) for frame in self.board.round(self._clock.now_s())).encode()
            for writer in self._listeners:
                if not writer.is_closing() and writer.transport.get_write_buffer_size() < BACKLOG_BYTES:
                    writer.write(text)
            due_s = max(due_s + self._period_s, loop.time())
            await asyncio.sleep(due_s - loop.time())


async def _command(reader: asyncio.StreamReader) -> str:
    """The words between `<` and `>`. Raises `ProtocolViolation`, `IncompleteReadError` where the client went."""
    try:
        raw = await reader.readuntil(b">")
    except asyncio.LimitOverrunError:
        raise ProtocolViolation("socketcand", "read", "a command without an end") from None
    if len(raw) > MAX_LINE_BYTES or not raw.isascii():
        raise ProtocolViolation("socketcand", "read", f"not a command: {raw[:40]!r}")
    return raw.decode().strip(" \r\n<>")


def _frame(can_id: str, length: str, data: list[str]) -> CanFrame:
    try:
        frame = CanFrame(int(can_id, 16), bytes(int(byte, 16) for byte in data))
        if len(frame.data) != int(length, 16):
            raise ValueError("length")
    except ValueError:
        raise ProtocolViolation("socketcand", "send", f"not a frame: {can_id} {length} {data[:8]}") from None
    return frame


def _ascii(frame: CanFrame) -> str:
    # Real time: it stands for the adapter's clock, whatever the pace of the simulated world.
    if frame.error:
        return f"< error {frame.can_id:03X} {time.time():.6f} >"
    return f"< frame {frame.can_id:03X} {time.time():.6f} {frame.data.hex().upper()} >"
