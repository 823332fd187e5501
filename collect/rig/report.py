"""`doctor --report`: one archive for a bug report. It holds the answers of the devices, and nothing that is secret.

| file | holds |
|---|---|
| `report.json` | versions, platform, the doctor's findings, numbers of `rig.toml`, the checks of `rig check` |
| `arcs.jsonl` | the transcript of the controller: one question and its answer a line; tests replay it |
| `rtde.json` | what RTDE offers and its newest sample, if `robot.rtde_port` is configured |
| `README.txt` | what is in it and what was taken out |
"""

from __future__ import annotations

import getpass
import importlib.metadata
import json
import os
import platform
import re
import socket
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.check import check_rig
from brushloop.collect.rig.config import PREFIX, RigConfig
from brushloop.collect.rig.doctor import Finding
from brushloop.drivers.arcs.survey import rtde_answers, survey
from brushloop.drivers.arcs.wire import Framing

FORMAT = 1
ENDING = ".zip"
ABOUT = """\
Made by `brushloop doctor --report`. Read it before you send it: it is meant to hold no secret.
report.json  versions, platform, what each device answered, the numbers of rig.toml and what is doubtful in them
arcs.jsonl   every question that was put to the arm's controller, and its answer
rtde.json    what the controller's telemetry offers, if it is configured
Taken out: names of hosts and users, addresses, paths, URLs, values of environment variables, every text of rig.toml.
There are no photographs in it.
"""
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
    """Replaces what identifies a person or a network: reports are sent to people outside the lab."""

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


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a process whose user has no name
        return ""


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


def check_report(path: Path) -> None:
    """Raise `ConfigError` if no archive can be written to this path. Called before any device is asked."""
    if path.suffix.lower() != ENDING:
        raise ConfigError("--report", "", f"{path} must end in {ENDING}")
    if not path.parent.is_dir():
        raise ConfigError("--report", "", f"{path}: there is no folder {path.parent}")
    if path.exists():
        raise ConfigError("--report", "", f"{path} exists and is not overwritten: choose another name")


async def write_report(path: Path, config: RigConfig, findings: list[Finding]) -> None:
    """Record a transcript of the controller and write the archive; `check_report` must have passed.

    Raises OSError if it cannot be written.
    """
    robot, scrubber = config.robot, scrubber_of(config)
    known = {
        "framing": robot.framing,
        "findings": scrubber.value([finding.as_json() for finding in findings]),
        "rig": numbers_only(config.model_dump(mode="json")),
        "checks": scrubber.value([asdict(check) for check in check_rig(config)]),
    }
    files = {"arcs.jsonl": await transcript(robot.host, robot.port, robot.framing, scrubber)}
    if robot.rtde_port is not None:
        answers = await rtde_answers(robot.host, robot.rtde_port)
        files["rtde.json"] = json.dumps(scrubber.value(answers), indent=2)
    write_archive(path, known, files)


async def transcript(host: str, port: int, framing: Framing, scrubber: Scrubber) -> str:
    """Every question to the controller and its answer, one JSON object a line, without names."""
    lines = [
        asdict(exchange) | {"took_ms": round(exchange.took_ms, 3)} for exchange in await survey(host, port, framing)
    ]
    return "".join(json.dumps(scrubber.value(line)) + "\n" for line in lines)


def write_archive(path: Path, known: dict[str, Any], files: dict[str, str]) -> None:
    """Write `report.json` with what is `known`, a README and these files. Raises OSError."""
    report = {
        "format": FORMAT,
        "versions": _versions(),
        "platform": {
            "system": platform.system(),
            "release": platform.release(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "cores": os.cpu_count(),
        },
        **known,
    }
    texts = {"README.txt": ABOUT, "report.json": json.dumps(report, indent=2), **files}
    with path.open("xb") as out, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(name, text)


def _versions() -> dict[str, str]:
    """Versions of brushloop and of its libraries."""
    found: dict[str, str] = {}
    for requirement in ("brushloop", *(importlib.metadata.requires("brushloop") or ())):
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # an extra that is not installed
    return found
