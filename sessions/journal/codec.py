"""One line of a journal as bytes and back. It has a CRC, and it names the line before it by its hash.

`chain` of a line holds `seq` (the line's number, from 1), `session` (its id) and `prev`: the SHA-256 of the line
before, or, in the first line that has one, of everything before.
"""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from dataclasses import dataclass
from typing import Any, cast

Line = dict[str, Any]
_TAIL = re.compile(rb',"crc":"([0-9a-f]{8})"\}\Z')
_WHOLE = re.compile(rb'\{"t_ns":.*?,"crc":"[0-9a-f]{8}"\}', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Chain:
    """Which line of which session this is, and what it follows."""

    seq: int
    session: str
    prev: str


@dataclass(frozen=True, slots=True)
class Entry:
    """One line that its own CRC vouches for."""

    number: int
    """Of the line in the file as it is now, from 1."""
    raw: bytes
    line: Line
    """What it says, without CRC and chain."""
    chain: Chain | None


def encode_line(t_ns: int, line: Line, chain: Chain | None = None) -> bytes:
    """One line with time and CRC, newline included. Raises `ValueError` for what JSON cannot hold."""
    linked: Line = {} if chain is None else {"chain": {"seq": chain.seq, "session": chain.session, "prev": chain.prev}}
    body = json.dumps({"t_ns": t_ns, **line, **linked}, separators=(",", ":"), allow_nan=False).encode()
    return with_crc(body) + b"\n"


def with_crc(body: bytes) -> bytes:
    """A JSON object with `crc`, the CRC-32 of the object without it, as its last field."""
    return body[:-1] + f',"crc":"{zlib.crc32(body):08x}"}}'.encode()


def digest(data: bytes) -> str:
    """What a chained line says of what it follows."""
    return hashlib.sha256(data).hexdigest()


class BadLine(Exception):
    """Says what is wrong with a line."""


def has_crc(raw: bytes) -> bool:
    """Whether the line ends as one with a CRC does."""
    return _TAIL.search(raw) is not None


def decode_line(raw: bytes, number: int, *, protected: bool) -> Entry:
    """One line without its newline. Raises `BadLine`; `protected` asks for a CRC."""
    tail = _TAIL.search(raw)
    try:
        line = json.loads(raw)
    except (ValueError, RecursionError):
        raise BadLine("is not JSON") from None
    if not isinstance(line, dict) or not isinstance(line.get("event"), str):  # pyright: ignore[reportUnknownMemberType]
        raise BadLine("has no event")
    line = cast("Line", line)
    if protected and (tail is None or zlib.crc32(raw[: tail.start()] + b"}") != int(tail[1], 16)):
        raise BadLine("does not match its CRC")
    if tail is not None:
        del line["crc"]
    return Entry(number, raw, line, _chain(line))


def lines_within(raw: bytes, number: int) -> tuple[list[Entry], list[bytes]]:
    """The lines in a span in which a newline is damaged, and what is left between them."""
    entries: list[Entry] = []
    spoilt: list[bytes] = []
    at = 0
    for match in _WHOLE.finditer(raw):
        try:
            entry = decode_line(match[0], number, protected=True)
        except BadLine:
            continue
        spoilt.append(raw[at : match.start()])
        entries.append(entry)
        at = match.end()
    spoilt.append(raw[at:])
    return entries, [span for span in spoilt if len(span) > 1]  # a single byte was the newline


def _chain(line: Line) -> Chain | None:
    if "chain" not in line:
        return None
    match line.pop("chain"):
        case {"seq": int(seq), "session": str(session), "prev": str(prev)} if not isinstance(seq, bool):
            return Chain(seq, session, prev)
        case _:
            raise BadLine("has a chain that cannot be read")
