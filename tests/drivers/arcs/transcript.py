"""Archives of `brushloop doctor --report`, and a controller that says again what the one in an archive said."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from brushloop.drivers.arcs.wire import Framing
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Device, Fault
from brushloop.drivers.sim.world import World


class Archive:
    """What `brushloop doctor --report` wrote."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            self.framing: Framing = json.loads(archive.read("report.json"))["framing"]
            self.lines: list[dict[str, Any]] = [json.loads(line) for line in archive.read("arcs.jsonl").splitlines()]
            """Each has method, params and answer."""


class Replayed(ArcsServer):
    """Gives the answers of an archive, in their order, whatever is asked."""

    def __init__(self, archive: Archive) -> None:
        super().__init__(World(SimConfig()))
        self._left = [line["answer"] for line in archive.lines]

    def _answer(self, request: dict[str, Any]) -> bytes:
        answer = self._left.pop(0)
        if "silence" in answer or "lost" in answer:
            self.faults.hang(Fault(device=Device.ROBOT, kind="mute" if "silence" in answer else "drop"))
        body = {key: value for key, value in answer.items() if key in ("result", "error")}  # of `refused`: neither
        return json.dumps({"id": request["id"], "jsonrpc": "2.0", **body}).encode()
