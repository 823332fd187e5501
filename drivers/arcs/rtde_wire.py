"""RTDE of ARCS as bytes: a greeting that ends with two newlines, then SOF frames of CBOR (or JSON) arrays.

| who | bytes |
|---|---|
| server, on accept | `{"protocol":"rtde","version":1,"input":{...},"output":{name: id, ...}}` LF LF |
| client, to subscribe | CBOR `[100, {chanel, frequency, segments, to_server, trigger}]` |
| server, from then on | CBOR or JSON `[chanel, value, value, ...]` in the order of the segments |
| client, when bored | `__ping__` NUL, without a frame |
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn

import cbor2

from drivers.arcs.frames import encode_short
from drivers.errors import ProtocolViolation

SET_RECIPE = 100
PING = b"__ping__\0"
GREETING_END = b"}\n\n"
MAX_GREETING_BYTES = 256 * 1024
MAX_MESSAGE_BYTES = 64 * 1024
MAX_DEPTH = 16


class _NoTags(Mapping[int, Any]):
    """Refuses whatever tag is looked up. Poses and modes need none, and a tagged regular expression of 64 KiB takes
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
    """Subscribe a channel; no segments at frequency 0 end it. The spelling is the maker's."""
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
    except Exception as error:  # what the decoders raise is not a closed list
        raise ProtocolViolation(device, "decode", f"neither CBOR nor JSON: {error}") from None
    match message:
        case [int(head), *rest] if not isinstance(head, bool):
            return head, rest  # pyright: ignore[reportUnknownVariableType]
        case _:
            raise ProtocolViolation(device, "decode", f"not an array with a channel: {payload[:20]!r}")
