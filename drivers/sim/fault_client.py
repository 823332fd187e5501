"""`brushloop fault` and `brushloop hand`: send one request to the control socket of a rig and print the answer."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

TIMEOUT_S = 5.0
GUIDING_S = 120.0
"""Longest wait for an act of the person in the lab."""
MAX_ANSWER_BYTES = 4 * 1024 * 1024
PLAIN = ("list", "clear", "state", "release", "fresh-sheet")


class FaultRefused(Exception):
    """No rig listens, or the rig refused the request."""

    exit_code: ClassVar[int] = 2


def request_of(what: str, kind: str | None, options: Mapping[str, object]) -> dict[str, Any]:
    """The request that the words of a command line ask for. Raises `FaultRefused`."""
    given = {name: value for name, value in options.items() if value is not None}
    if what not in PLAIN:
        if kind is None:
            raise FaultRefused(f"{what}: give a device and a kind, or one of {', '.join(PLAIN)}")
        given.pop("id", None)
        return {"do": "add", "fault": {"device": what, "kind": kind, **given}}
    if kind is not None or set(given) - ({"id"} if what == "clear" else set[str]()):
        allowed = "no option but --id" if what == "clear" else "no options"
        raise FaultRefused(f"{what}: takes no kind and {allowed}")
    return {"do": what, **given}


def ask(path: Path, request: Mapping[str, object]) -> dict[str, Any]:
    """Send a request; return the rig's answer. Raises `FaultRefused`, with one line, if it is missing or a refusal."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(GUIDING_S if request["do"] == "hand" else TIMEOUT_S)
            client.connect(str(path))
            client.sendall(json.dumps(request).encode() + b"\n")
            line = _read_line(client)
    except OSError as error:
        raise FaultRefused(f"{path}: no rig answers here: {error.strerror or error}") from None
    try:
        answer: Any = json.loads(line)
    except (ValueError, RecursionError):
        raise FaultRefused(f"{path}: the answer is not JSON") from None
    match answer:
        case {"ok": True, **rest}:
            return rest  # pyright: ignore[reportUnknownVariableType]
        case {"ok": False, "error": str(error)}:
            raise FaultRefused(error)
        case _:
            raise FaultRefused(f"{path}: not the control socket of a rig")


def _read_line(client: socket.socket) -> bytes:
    line = b""
    while not line.endswith(b"\n") and len(line) < MAX_ANSWER_BYTES and (more := client.recv(65536)):
        line += more
    return line
