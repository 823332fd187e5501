"""Remove what identifies a person or a network from a report, because reports are sent to people outside the lab."""

from __future__ import annotations

import getpass
import os
import re
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from brushloop.collect.rig.config import PREFIX, RigConfig

SHORTEST = 3
"""A shorter name would be found within ordinary words."""
PATTERNS = (
    (re.compile(r"\b[a-z][a-z0-9+.-]*://\S+", re.IGNORECASE), "<url>"),
    (re.compile(r"\S+@[\w-]+(\.[\w-]+)+"), "<e-mail>"),
    (re.compile(r"\b(?:[0-9a-f]{2}[:-]){5}[0-9a-f]{2}\b", re.IGNORECASE), "<address>"),
    (re.compile(r"\b\d{1,3}(?:\.\d{1,3}){3}\b"), "<address>"),
    (re.compile(r"(?<![\w.])(?:[0-9a-f]{0,4}:){3,7}[0-9a-f]{0,4}(?![\w.])", re.IGNORECASE), "<address>"),
    (re.compile(r"(?<![\w<>/])(?:~|/)[\w.~+-]*/[^\s'\",;]+"), "<path>"),
    (re.compile(r"\b[A-Za-z]:\\[^\s'\",;]+"), "<path>"),
)
KEPT = frozenset({"kind", "interface", "framing", "dictionary", "method"})
"""Fields of `rig.toml` whose text is one of a few fixed words; all other text in it is left out."""


class Scrubber:
    """Replaces names of hosts and users, addresses, paths, and values of environment variables."""

    def __init__(self, known: Mapping[str, str]) -> None:
        """`known` are names of this rig, and what stands for each."""
        names = {value: "<environment>" for name, value in os.environ.items() if name.upper().startswith(PREFIX)}
        names |= known
        names |= {
            socket.gethostname(): "<host>",
            socket.getfqdn(): "<host>",
            _user(): "<user>",
            str(Path.home()): "<path>",
            str(Path.cwd()): "<path>",
        }
        self._names = sorted(((k, v) for k, v in names.items() if len(k) >= SHORTEST), key=lambda pair: -len(pair[0]))

    def text(self, text: str) -> str:
        """The text with all of these replaced."""
        for name, stands_for in self._names:
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", stands_for, text)
        for pattern, stands_for in PATTERNS:
            text = pattern.sub(stands_for, text)
        return text

    def value(self, value: Any) -> Any:
        """The same for every text in a JSON value."""
        match value:
            case str():
                return self.text(value)
            case dict():
                return {key: self.value(inner) for key, inner in cast("dict[str, Any]", value).items()}
            case list() | tuple():
                return [self.value(inner) for inner in cast("list[Any]", value)]
            case _:
                return value


def scrubber_of(config: RigConfig) -> Scrubber:
    """A scrubber that knows the names in `rig.toml`."""
    force, device = config.force, config.ink.device
    names = {config.robot.host: "<host>", config.camera.source: "<camera>"}
    names |= {force.host or "": "<host>"} if force is not None else {}
    names |= {device.port: "<port>"} if device is not None else {}
    return Scrubber(names)


def numbers_only(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table of `rig.toml` without its texts, which may name anything."""

    def kept(name: str, value: Any) -> Any:
        match value:
            case str() if name not in KEPT:
                return "<text>"
            case dict():
                return numbers_only(cast("dict[str, Any]", value))
            case _:
                return value

    return {name: kept(name, value) for name, value in table.items()}


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a process whose user has no name
        return ""
