"""RTDE, the controller's push of samples: a greeting that ends with two newlines, then SOF frames of CBOR (or JSON).

| who | bytes |
|---|---|
| server, on accept | `{"protocol":"rtde","version":1,"input":{...},"output":{name: id, ...}}` LF LF |
| client, to subscribe | CBOR `[100, {chanel, frequency, segments, to_server, trigger}]` |
| server, from then on | CBOR or JSON `[chanel, value, value, ...]` in the order of the segments |
| client, when idle | `__ping__` NUL, without a frame |
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn

import cbor2

from brushloop.drivers.arcs.framing import FrameDecoder, encode_short
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, ProtocolViolation

SET_RECIPE = 100
PING = b"__ping__\0"
GREETING_END = b"}\n\n"
MAX_GREETING_BYTES = 256 * 1024
MAX_MESSAGE_BYTES = 64 * 1024
MAX_DEPTH = 16


class _NoTags(Mapping[int, Any]):
    """Refuses every tag. Poses and modes need none, and a tagged regular expression of 64 KiB takes
    cbor2 half a minute to compile, a tagged big decimal half a second."""

    def __getitem__(self, tag: int) -> Any:
        return _refuse

    def __iter__(self) -> Iterator[int]:
        return iter(())

    def __len__(self) -> int:
        return 1


def _refuse(*_: object) -> NoReturn:
    raise ValueError("a tagged value")


def outputs_of(greeting: bytes, device: str) -> dict[str, int]:
    """The names that can be subscribed to, with their ids. Raises `ProtocolViolation`."""
    try:
        hello: Any = json.loads(greeting)
    except (ValueError, RecursionError):
        raise ProtocolViolation(device, "greeting", f"not JSON: {greeting[:40]!r}") from None
    match hello:
        case {"protocol": "rtde", "output": dict(outputs)}:  # pyright: ignore[reportUnknownVariableType]
            return {str(name): ident for name, ident in outputs.items() if isinstance(ident, int)}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        case _:
            raise ProtocolViolation(device, "greeting", f"not a greeting of RTDE: {greeting[:40]!r}")


def encode_topic(chanel: int, segments: Sequence[str], frequency_hz: float) -> bytes:
    """Message that subscribes a channel; no segments at frequency 0 end it. The spelling is the maker's."""
    topic = {
        "chanel": chanel,
        "frequency": float(frequency_hz),
        "segments": list(segments),
        "to_server": False,
        "trigger": 0,
    }
    return encode_short(cbor2.dumps([SET_RECIPE, topic]))


def encode_sample(chanel: int, values: Sequence[object]) -> bytes:
    """One push of a channel."""
    return encode_short(cbor2.dumps([chanel, *values]))


def decode_message(payload: bytes, device: str) -> tuple[int, list[Any]]:
    """(channel or command, what follows it). Raises `ProtocolViolation`."""
    try:
        if payload.startswith(b"["):
            message: Any = json.loads(payload)
        else:
            message = cbor2.loads(
                payload, semantic_decoders=_NoTags(), tag_hook=_refuse, max_depth=MAX_DEPTH, strict_hashable_types=True
            )
    except Exception as error:  # the decoders may raise anything
        raise ProtocolViolation(device, "decode", f"neither CBOR nor JSON: {error}") from None
    match message:
        case [int(head), *rest] if not isinstance(head, bool):
            return head, rest  # pyright: ignore[reportUnknownVariableType]
        case _:
            raise ProtocolViolation(device, "decode", f"not an array with a channel: {payload[:20]!r}")


DEVICE = "robot telemetry"
CHANNEL = 0


class RtdeStream:
    """One subscription on a socket of its own; a reader gets the newest sample, never a backlog."""

    def __init__(self, host: str, port: int, *, timeout_s: float = 0.5) -> None:
        self.host = host
        self.port = port
        self._timeout_s = timeout_s
        self._decoder = FrameDecoder(DEVICE, skip=PING, max_bytes=MAX_MESSAGE_BYTES)
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._segments: tuple[str, ...] = ()
        self.offered: dict[str, int] = {}
        """Names in the greeting that can be subscribed to, with their ids."""
        self.older: list[list[Any]] = []
        """Samples that had piled up before the newest one when it was read, oldest first."""

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
        self.offered = outputs_of(greeting, DEVICE)
        missing = set(segments) - set(self.offered)
        if missing:
            raise ProtocolViolation(DEVICE, "subscribe", f"the controller does not offer {sorted(missing)}")
        self._segments = tuple(segments)
        self._writer.write(encode_topic(CHANNEL, segments, frequency_hz))

    async def newest(self) -> list[Any]:
        """The values of the newest sample, in the order of the segments.

        If several have piled up, the arrival time of the older ones is unknown; they are left in `older`. Raises
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
