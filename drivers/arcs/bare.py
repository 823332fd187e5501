"""Bare JSON of ARCS: one document after another, with nothing between them and no newline at the end.

The end of a document is found by its brackets. Parsing again and again until it succeeds would take quadratic time on
a reply that comes in small pieces, and could not tell a reply that is cut off from one that is wrong.
"""

from __future__ import annotations

import json
import re

from drivers.errors import ProtocolViolation

MAX_DOCUMENT_BYTES = 1024 * 1024
"""Far above any reply of a controller."""
MAX_DEPTH = 64
"""No reply nests deeper than five; the parser must not run out of stack."""

_STRUCTURE = re.compile(rb'["{}\[\]]')
_STRING_END = re.compile(rb'["\\]')
_CLOSES = {ord("}"): ord("{"), ord("]"): ord("[")}


class BareDecoder:
    """Turns a byte stream, cut anywhere, into JSON documents; bounded in size and depth."""

    def __init__(self, device: str = "arcs", *, max_bytes: int = MAX_DOCUMENT_BYTES) -> None:
        self._device = device
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._at = 0
        self._open: list[int] = []
        self._in_string = False
        self._broken: str | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """Documents completed by `data`, in order, each JSON as Python takes it: NaN and Infinity are let through.

        Raises `ProtocolViolation`, and from then on always: nothing after it, nor of the same `data`, can be trusted.
        """
        if self._broken is not None:
            raise self._violation(self._broken)
        self._buffer += data
        documents: list[bytes] = []
        while (document := self._next()) is not None:
            documents.append(document)
        return documents

    def _next(self) -> bytes | None:
        if not self._open:
            del self._buffer[: len(self._buffer) - len(self._buffer.lstrip(b" \t\r\n"))]
            if self._buffer and self._buffer[0] not in b"{[":
                raise self._violation(f"expected JSON, got {bytes(self._buffer[:8])!r}")
        end = self._scan()
        if (end or len(self._buffer)) > self._max_bytes:
            raise self._violation(f"document exceeds {self._max_bytes} bytes")
        if end is None:
            return None
        document = bytes(self._buffer[:end])
        del self._buffer[:end]
        self._at = 0
        try:
            json.loads(document)
        except (ValueError, RecursionError):
            raise self._violation(f"not JSON: {document[:40]!r}") from None
        return document

    def _scan(self) -> int | None:
        """Go on from where the last piece ended; the end of the document, or None where it is not here yet."""
        buffer = self._buffer
        while True:
            found = (_STRING_END if self._in_string else _STRUCTURE).search(buffer, self._at)
            if found is None:
                self._at = len(buffer)
                return None
            byte, self._at = buffer[found.start()], found.end()
            if byte == ord("\\"):
                if self._at == len(buffer):  # what it escapes is not here yet: look at it again
                    self._at -= 1
                    return None
                self._at += 1
            elif byte == ord('"'):
                self._in_string = not self._in_string
            elif byte in _CLOSES:
                if self._open.pop() != _CLOSES[byte]:
                    raise self._violation("brackets do not match")
                if not self._open:
                    return self._at
            else:
                self._open.append(byte)
                if len(self._open) > MAX_DEPTH:
                    raise self._violation(f"nested deeper than {MAX_DEPTH}")

    def _violation(self, what: str) -> ProtocolViolation:
        self._broken = what
        self._buffer.clear()
        return ProtocolViolation(self._device, "decode", what)
