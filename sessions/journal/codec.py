"""One line of a journal as bytes and back. It has a CRC, and holds the hash of the line before it.

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
    """Link to the preceding line: number of this line, its session, and the hash of what precedes it."""

    seq: int
    session: str
    prev: str


@dataclass(frozen=True, slots=True)
class Entry:
    """One line that matches its CRC."""

    number: int
    """Number of the line in the file as it is now, from 1."""
    raw: bytes
    line: Line
    """Content without CRC and chain."""
    chain: Chain | None


def encode_line(t_ns: int, line: Line, chain: Chain | None = None) -> bytes:
    """Encode a line with time, CRC and newline. Raises `ValueError` for values that JSON cannot hold."""
    linked: Line = {} if chain is None else {"chain": {"seq": chain.seq, "session": chain.session, "prev": chain.prev}}
    body = json.dumps({"t_ns": t_ns, **line, **linked}, separators=(",", ":"), allow_nan=False).encode()
    return with_crc(body) + b"\n"


def without_time(line: Line) -> Line:
    """The line without its time, which `encode_line` adds."""
    return {name: value for name, value in line.items() if name != "t_ns"}


def with_crc(body: bytes) -> bytes:
    """Add `crc`, the CRC-32 of the object so far, as the last field of a JSON object."""
    return body[:-1] + f',"crc":"{zlib.crc32(body):08x}"}}'.encode()


def digest(data: bytes) -> str:
    """SHA-256 of everything that precedes a chained line."""
    return hashlib.sha256(data).hexdigest()


class BadLine(Exception):
    """A line cannot be used; the message says why."""


def has_crc(raw: bytes) -> bool:
    """Whether the line ends with a CRC."""
    return _TAIL.search(raw) is not None


def decode_line(raw: bytes, number: int, *, protected: bool) -> Entry:
    """Decode a line without its newline; `protected` requires a CRC. Raises `BadLine`."""
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
    """Find the lines in a span with a damaged newline, and the bytes left between them."""
    entries: list[Entry] = []
    damaged: list[bytes] = []
    at = 0
    for match in _WHOLE.finditer(raw):
        try:
            entry = decode_line(match[0], number, protected=True)
        except BadLine:
            continue
        damaged.append(raw[at : match.start()])
        entries.append(entry)
        at = match.end()
    damaged.append(raw[at:])
    return entries, [span for span in damaged if len(span) > 1]  # a single byte was the newline


def _chain(line: Line) -> Chain | None:
    if "chain" not in line:
        return None
    match line.pop("chain"):
        case {"seq": int(seq), "session": str(session), "prev": str(prev)} if not isinstance(seq, bool):
            return Chain(seq, session, prev)
        case _:
            raise BadLine("has a chain that cannot be read")
