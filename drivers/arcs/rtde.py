"""One RTDE subscription: the controller pushes, nobody asks."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from typing import Any

from drivers.arcs.frames import FrameDecoder
from drivers.arcs.rtde_wire import (
    GREETING_END,
    MAX_GREETING_BYTES,
    MAX_MESSAGE_BYTES,
    PING,
    decode_message,
    encode_topic,
    outputs_of,
)
from drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, ProtocolViolation

DEVICE = "robot telemetry"
CHANNEL = 0


class RtdeStream:
    """A socket of its own; whoever reads it gets the newest sample, never a backlog."""

    def __init__(self, host: str, port: int, *, timeout_s: float = 0.5) -> None:
        self.host = host
        self.port = port
        self._timeout_s = timeout_s
        self._decoder = FrameDecoder(DEVICE, skip=PING, max_bytes=MAX_MESSAGE_BYTES)
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._segments: tuple[str, ...] = ()
        self.older: list[list[Any]] = []
        """What had piled up before the newest sample when that was read, oldest first."""

    async def open(self, segments: Sequence[str], frequency_hz: float) -> None:
        """Connect, read the greeting, subscribe. Raises `ConnectionLost`, `DeviceTimeout`, `ProtocolViolation`."""
        try:
            async with asyncio.timeout(self._timeout_s):
                self._reader, self._writer = await asyncio.open_connection(
                    self.host, self.port, limit=MAX_GREETING_BYTES
                )
                greeting = await self._reader.readuntil(GREETING_END)
        except TimeoutError:
            raise DeviceTimeout(DEVICE, "connect", f"no greeting from {self.host}:{self.port}") from None
        except asyncio.LimitOverrunError:
            raise ProtocolViolation(DEVICE, "connect", "a greeting without an end") from None
        except (OSError, asyncio.IncompleteReadError) as error:
            raise ConnectionLost(DEVICE, "connect", f"{self.host}:{self.port}: {error}") from None
        missing = set(segments) - set(outputs_of(greeting, DEVICE))
        if missing:
            raise ProtocolViolation(DEVICE, "subscribe", f"the controller does not offer {sorted(missing)}")
        self._segments = tuple(segments)
        self._writer.write(encode_topic(CHANNEL, segments, frequency_hz))

    async def newest(self) -> list[Any]:
        """The values of the newest sample, in the order of the segments.

        Where several have piled up, nobody knows any more when the others came; they are left in `older`. Raises
        `DeviceTimeout` after silence, `ConnectionLost`, `ProtocolViolation`.
        """
        if self._reader is None:
            raise NotConnected(DEVICE, "read", "not connected")
        samples: list[list[Any]] = []
        try:
            async with asyncio.timeout(self._timeout_s):
                while not samples:
                    data = await self._reader.read(MAX_MESSAGE_BYTES)
                    if not data:
                        raise ConnectionLost(DEVICE, "read", "the controller closed the connection")
                    for payload in self._decoder.feed(data):
                        head, values = decode_message(payload, DEVICE)
                        if head == CHANNEL:
                            samples.append(values)
        except TimeoutError:
            raise DeviceTimeout(DEVICE, "read", f"no sample in {self._timeout_s:g} s") from None
        except OSError as error:
            if isinstance(error, ConnectionLost):
                raise
            raise ConnectionLost(DEVICE, "read", error.strerror or str(error)) from None
        for values in samples:
            if len(values) != len(self._segments):
                raise ProtocolViolation(DEVICE, "read", f"{len(values)} values for {len(self._segments)} segments")
        *self.older, newest = samples
        return newest

    async def close(self) -> None:
        """End the subscription and close the socket."""
        writer, self._writer, self._reader = self._writer, None, None
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.write(encode_topic(CHANNEL, (), 0.0))
                writer.close()
                await writer.wait_closed()
