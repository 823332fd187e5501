"""Lines of a journal as bytes and back. Each ends with a CRC of its own, so that one wrong bit is seen.

Journals written before lines had a CRC are read as well; within one journal it is all lines or none.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sessions.errors import SessionDamaged, SessionError, in_one_line

Line = dict[str, Any]
_TAIL = re.compile(rb',"crc":"([0-9a-f]{8})"\}\Z')
_WHOLE = re.compile(rb'\{"t_ns":.*?,"crc":"[0-9a-f]{8}"\}', re.DOTALL)
MAX_STRANGE_BYTES = 30
"""A rebuilt line may differ from the damaged one in its time (19 digits), its CRC (8) and the damage itself."""


def encode_line(t_ns: int, line: Line) -> bytes:
    """One line with time and CRC, newline included. Raises `ValueError` for what JSON cannot hold."""
    body = json.dumps({"t_ns": t_ns, **line}, separators=(",", ":"), allow_nan=False).encode()
    return with_crc(body) + b"\n"


def with_crc(body: bytes) -> bytes:
    """A JSON object with `crc`, the CRC-32 of the object without it, as its last field."""
    return body[:-1] + f',"crc":"{zlib.crc32(body):08x}"}}'.encode()


def read_lines(path: Path) -> Iterator[Line]:
    """Every complete line. A torn last line is left out; damage anywhere else raises `SessionDamaged`."""
    pieces = read_journal(path).split(b"\n")[:-1]
    protected = any(_TAIL.search(raw) for raw in pieces)
    for number, raw in enumerate(pieces, start=1):
        try:
            yield _decode(raw, protected)
        except _BadLine as error:
            raise SessionDamaged(path, f"line {number} {error}") from None


def read_journal(path: Path) -> bytes:
    """The bytes of a journal. Raises `SessionError`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise SessionError(path, f"cannot read: {in_one_line(error)}") from None


@dataclass(frozen=True, slots=True)
class Recovered:
    """What a damaged journal still says, and the bytes that say nothing."""

    lines: list[Line]
    spoilt: list[bytes]
    """Without a torn last line."""
    torn: bytes
    """A last line that a crash cut off: harmless, the next process sets it aside."""
    whole: bool
    """True where the journal reads as it is, apart from a torn last line."""


def recover_lines(data: bytes) -> Recovered:
    """Every line that its CRC vouches for, also where the newline between two of them is damaged."""
    protected = _WHOLE.search(data) is not None
    lines: list[Line] = []
    spoilt: list[bytes] = []
    *pieces, tail = data.split(b"\n")
    for raw in [*pieces, *filter(None, [tail])]:
        try:
            lines.append(_decode(raw, protected))
        except _BadLine:
            found, left = _within(raw) if protected else ([], [raw])
            lines += found
            spoilt += left
    torn = tail if spoilt and spoilt[-1] == tail else b""
    if torn:
        del spoilt[-1]
    return Recovered(lines, spoilt, torn, whole=len(lines) == len(pieces) and tail == torn and not spoilt)


def accounts_for(spoilt: bytes, rebuilt: bytes) -> bool:
    """Whether a damaged line, cut short or with wrong bytes, was this one."""
    rebuilt = rebuilt.rstrip(b"\n")
    if not len(rebuilt) // 2 <= len(spoilt) <= len(rebuilt):
        return False
    strange = sum(a != b for a, b in zip(spoilt, rebuilt, strict=False))
    return strange <= min(MAX_STRANGE_BYTES, len(spoilt) // 2)


class _BadLine(Exception):
    """Says what is wrong with a line."""


def _decode(raw: bytes, protected: bool) -> Line:
    tail = _TAIL.search(raw)
    try:
        line = json.loads(raw)
    except (ValueError, RecursionError):
        raise _BadLine("is not JSON") from None
    if not isinstance(line, dict) or not isinstance(line.get("event"), str):  # pyright: ignore[reportUnknownMemberType]
        raise _BadLine("has no event")
    if protected and (tail is None or zlib.crc32(raw[: tail.start()] + b"}") != int(tail[1], 16)):
        raise _BadLine("does not match its CRC")
    if tail is not None:
        del line["crc"]
    return line  # pyright: ignore[reportUnknownVariableType]


def _within(raw: bytes) -> tuple[list[Line], list[bytes]]:
    lines: list[Line] = []
    spoilt: list[bytes] = []
    at = 0
    for match in _WHOLE.finditer(raw):
        try:
            line = _decode(match[0], True)
        except _BadLine:
            continue
        spoilt.append(raw[at : match.start()])
        lines.append(line)
        at = match.end()
    spoilt.append(raw[at:])
    return lines, [span for span in spoilt if len(span) > 1]  # a single byte was the newline
