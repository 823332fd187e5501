"""What becomes of a reply of the controller's on its way out."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import Callable

from drivers.sim.faults.vocabulary import Fault

PIECE_S = 0.001
CUTS = (2, 6, 9)
"""Within the mark, within the length, and just behind the head of a frame."""
GARBAGE = b"\x00\xffnothing that anyone speaks\r\n"


class Dropped(ConnectionError):
    """The connection is to be closed instead of an answer."""


class Replies:
    """The way of one connection's replies to its client, faults included."""

    def __init__(self, writer: asyncio.StreamWriter, frame: Callable[[bytes], bytes]) -> None:
        self._writer = writer
        self._frame = frame
        self._late: set[asyncio.TimerHandle] = set()

    async def send(self, answer: bytes, fault: Fault | None) -> None:
        """Send the answer, or what the fault makes of it. Raises `Dropped`."""
        match fault.kind if fault is not None else "":
            case "mute":
                return
            case "drop":
                raise Dropped
            case "late":
                assert fault is not None
                self._later(fault.late_s, self._frame(answer))
            case "split":
                await self._in_pieces(self._frame(answer))
            case "duplicate":
                self._writer.write(self._frame(answer) * 2)
            case "wrong-id":
                self._writer.write(self._frame(_with_another_id(answer)))
            case "malformed":
                self._writer.write(self._frame(answer[: len(answer) // 2]))
            case "garbage":
                self._writer.write(GARBAGE)
            case _:
                # In one piece: the vendor's client never recovers from a header that comes in two.
                self._writer.write(self._frame(answer))
        await self._writer.drain()

    def close(self) -> None:
        """Forget replies that have not gone out yet."""
        for handle in self._late:
            handle.cancel()
        self._late.clear()

    def _later(self, after_s: float, whole: bytes) -> None:
        def send() -> None:
            self._late.discard(handle)
            if not self._writer.is_closing():
                self._writer.write(whole)

        handle = asyncio.get_running_loop().call_later(after_s, send)
        self._late.add(handle)

    async def _in_pieces(self, whole: bytes) -> None:
        edges = sorted({0, *(cut for cut in (*CUTS, len(whole) // 2) if cut < len(whole)), len(whole)})
        for begin, end in itertools.pairwise(edges):
            self._writer.write(whole[begin:end])
            await self._writer.drain()
            await asyncio.sleep(PIECE_S)


def _with_another_id(answer: bytes) -> bytes:
    """A sound reply to a request that nobody made; the login's reply has no id and becomes one that has."""
    try:
        body = json.loads(answer)
    except ValueError:
        body = {"id": "", "jsonrpc": "2.0", "result": 0}
    ident = body.get("id")
    body["id"] = ident + 1000 if isinstance(ident, int) else "ZZZZZZZZ-ZZZZ-ZZZZ"
    return json.dumps(body, separators=(",", ":")).encode()
