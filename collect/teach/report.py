"""`doctor --report` on the first day, before there is a `rig.toml`: what is known so far, and what the arm answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from brushloop.collect.rig.doctor import Finding
from brushloop.collect.rig.report import about_this_machine, transcript, write_archive
from brushloop.collect.rig.scrub import Scrubber, numbers_only
from brushloop.collect.teach.arm_reader import Address
from brushloop.collect.teach.store import Notebook

NAMES = {
    "robot.host": "<host>",
    "aside.address": "<host>",
    "camera.source": "<camera>",
    "force.host": "<host>",
    "aside.bus": "<host>",
    "ink.device.port": "<port>",
}
"""Values that identify the lab, and the placeholder for each."""


async def write_first_report(path: Path, notebook: Notebook) -> None:
    """Write the archive, with the controller's replies word for word if its address is known. Raises OSError.

    `check_report` must have passed.
    """
    scrubber = Scrubber({str(notebook.get(field) or ""): stands_for for field, stands_for in NAMES.items()})
    report: dict[str, Any] = about_this_machine() | {
        "framing": notebook.framing,
        "findings": [scrubber.value(_robot(notebook).as_json())],
        "done": notebook.done,
        "taught": numbers_only({field: taught.value for field, taught in notebook.values.items()}),
        "touched": {name: touch.position_mm for name, touch in notebook.touches.items()},
    }
    files = {"report.json": json.dumps(report, indent=2), "arcs.jsonl": ""}
    if (typed := notebook.get("aside.address")) is not None:
        address = Address.of(str(typed))
        files["arcs.jsonl"] = await transcript(address.host, address.port, notebook.framing, scrubber)
    write_archive(path, files)


def _robot(notebook: Notebook) -> Finding:
    """What is known of the arm; its identity is in the transcript, word for word."""
    how = "" if (kind := notebook.values.get("robot.kind")) is None else kind.how
    return Finding("robot", str(notebook.get("aside.address") or ""), answers=bool(how), notes=how)
