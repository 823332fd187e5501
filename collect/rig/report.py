"""`doctor --report`: one archive for a bug report. It holds the answers of the devices, and nothing that is secret.

| file | holds |
|---|---|
| `report.json` | versions, platform, the doctor's findings, numbers of `rig.toml`, the checks of `rig check` |
| `arcs.jsonl` | the transcript of the controller: one question and its answer a line; tests replay it |
| `rtde.json` | what RTDE offers and its newest sample, if `robot.rtde_port` is configured |
| `README.txt` | what is in it and what was taken out |
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.check import check_rig
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.doctor import Finding
from brushloop.collect.rig.scrub import Scrubber, numbers_only, scrubber_of
from brushloop.drivers.arcs.survey import Exchange, rtde_answers, survey
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
    files = {
        "report.json": json.dumps(_report(config, findings, scrubber), indent=2),
        "arcs.jsonl": await transcript(robot.host, robot.port, robot.framing, scrubber),
    }
    if robot.rtde_port is not None:
        answers = await rtde_answers(robot.host, robot.rtde_port)
        files["rtde.json"] = json.dumps(scrubber.value(answers), indent=2)
    write_archive(path, files)


def write_archive(path: Path, files: dict[str, str]) -> None:
    """Write these files, and a README that describes them. Raises OSError."""
    with path.open("xb") as out, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in {"README.txt": ABOUT, **files}.items():
            archive.writestr(name, text)


async def transcript(host: str, port: int, framing: Framing, scrubber: Scrubber) -> str:
    """Every question to the controller and its answer, one JSON object a line, without names."""
    exchanges = await survey(host, port, framing)
    return "".join(json.dumps(scrubber.value(_line(exchange))) + "\n" for exchange in exchanges)


def _line(exchange: Exchange) -> dict[str, Any]:
    return asdict(exchange) | {"took_ms": round(exchange.took_ms, 3)}


def _report(config: RigConfig, findings: list[Finding], scrubber: Scrubber) -> dict[str, Any]:
    return {
        **about_this_machine(),
        "framing": config.robot.framing,
        "findings": scrubber.value([finding.as_json() for finding in findings]),
        "rig": numbers_only(config.model_dump(mode="json")),
        "checks": scrubber.value([check.as_json() for check in check_rig(config)]),
    }


def about_this_machine() -> dict[str, Any]:
    """What every report begins with: its format, versions and the platform."""
    return {
        "format": FORMAT,
        "versions": _versions(),
        "platform": {
            "system": platform.system(),
            "release": platform.release(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "cores": os.cpu_count(),
        },
    }


def _versions() -> dict[str, str]:
    """Versions of brushloop and of its libraries."""
    named = ["brushloop", *(importlib.metadata.requires("brushloop") or ())]
    found: dict[str, str] = {}
    for requirement in named:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # an extra that is not installed
    return found
