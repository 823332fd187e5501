"""The SRI M8123B2 force board behind a CAN gateway: socketcand's ASCII protocol over TCP, as python-can speaks it.

| from the client | from the gateway |
|---|---|
| | `< hi >` on connecting |
| `< open NAME >` | `< ok >`, or `< error could not open bus >` |
| `< rawmode >` | `< ok >`, and from then on every frame of the bus |
| `< send ID LENGTH BYTE BYTE ... >` | nothing; the frame is put on the bus |
| | `< frame ID SECONDS HEX >`, `< error ID SECONDS >` |
"""

import asyncio
import math
import random
import time
from collections.abc import Callable, Iterator

from brushloop.drivers.force.sri_m8123 import BUS_OFF, COMMAND_ID, LOOPBACK_CHANNEL, START, STOP, Wrench, encode_round
from brushloop.drivers.host import alongside
from brushloop.drivers.loopback import LoopbackServer

BUS_ERROR = 0x04
"""Class of an error frame: the controller has a problem but is on the bus."""
ERROR_FRAME = 0x20000000
"""Flag of an error frame in its id, as in Linux `can/error.h`."""

CanFrame = tuple[int, bytes]
"""Id, of 11 bits but for the flag, and data of one frame on the bus."""


class ForceBoard:
    """Measures `force()` with seeded noise, from the start command to the stop command."""

    def __init__(
        self, force: Callable[[], Wrench], *, noise_n: float = 0.0, noise_nm: float = 0.0, seed: int = 1
    ) -> None:
        self.streaming = False
        self._force = force
        self._noise = (noise_n,) * 3 + (noise_nm,) * 3
        self._random = random.Random(seed)
        self.next_fault: Callable[[], str | None] = lambda: None
        """Asked for the fault of each round."""
        self._last: Wrench = (0.0,) * 6

    def obey(self, can_id: int, data: bytes) -> None:
        """Carry out a command frame from the bus; ignore other frames."""
        if can_id == COMMAND_ID and data in (START, STOP):
            self.streaming = data == START

    def round(self) -> Iterator[CanFrame]:
        """The frames of the round that is due now; none while the board is stopped."""
        if not self.streaming:
            return
        fault = self.next_fault()
        if fault == "silence":
            return
        if fault in ("bus-off", "bus-error"):
            self.streaming = fault != "bus-off"
            yield ERROR_FRAME | (BUS_OFF if fault == "bus-off" else BUS_ERROR), bytes(8)
            return
        if fault != "stuck":
            pairs = zip(self._force(), self._noise, strict=True)
            self._last = tuple(value + self._random.gauss(0.0, sigma) for value, sigma in pairs)
        wrench = tuple(math.nan if fault == "nan" and axis == 2 else value for axis, value in enumerate(self._last))
        for place, frame in enumerate(encode_round(wrench)):
            if fault != "no-second" or place != 1:
                yield frame


FRAME_S = 0.0002
"""From one frame of a round to the next on the bus."""


class SocketcandServer(LoopbackServer):
    """One board on one bus. Each client gets rounds of its own."""

    def __init__(self, board: ForceBoard, *, rate_hz: float) -> None:
        super().__init__()
        self.board = board
        self._period_s = 1.0 / rate_hz

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Open the bus for the client, then relay its frames and the board's until it disconnects."""
        writer.write(b"< hi >")
        while (words := await _command(reader)) != ["rawmode"]:
            writer.write(b"< ok >" if words == ["open", LOOPBACK_CHANNEL] else b"< error could not open bus >")
        writer.write(b"< ok >")
        # python-can takes rounds that arrive with the reply for a part of it, and the board of a killed run sends on.
        await self._obey(reader)
        async with alongside(self._send_rounds(writer), "force rounds"):
            while True:
                await self._obey(reader)

    async def _obey(self, reader: asyncio.StreamReader) -> None:
        """Give the board the next frame of the client."""
        _send, can_id, _length, *data = await _command(reader)
        self.board.obey(int(can_id, 16), bytes(int(byte, 16) for byte in data))

    async def _send_rounds(self, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while not writer.is_closing():
            # Real time, like that of an adapter's clock, whatever the rate of simulated time. It is read once: a board
            # sends its frames in one burst, however busy the computer is.
            at_s = time.time()
            text = "".join(_ascii(*frame, at_s + place * FRAME_S) for place, frame in enumerate(self.board.round()))
            writer.write(text.encode())
            await writer.drain()  # a client that does not read is sent nothing more until it has caught up
            due_s = max(due_s + self._period_s, loop.time())
            await asyncio.sleep(due_s - loop.time())


async def _command(reader: asyncio.StreamReader) -> list[str]:
    """The words of the next command. Raises ValueError for bytes that are no text."""
    return (await reader.readuntil(b">")).decode("ascii").strip(" \r\n<>").split(" ")


def _ascii(can_id: int, data: bytes, at_s: float) -> str:
    if can_id & ERROR_FRAME:
        return f"< error {can_id & ~ERROR_FRAME:03X} {at_s:.6f} >"
    return f"< frame {can_id:03X} {at_s:.6f} {data.hex().upper()} >"
