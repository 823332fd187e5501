"""The loopback rig in a process of its own: for a notebook, a lab's tests and the demo; and requests to it.

A simulator needs an interpreter of its own: it keeps real time while the process that uses it computes. It also holds
the simulated sheet, and the rig of a demo outlives the demo, so it is started as the command that serves it.
"""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

START_S = 120.0
"""Longest start; a busy machine may need most of it."""
POLL_S = 0.05
RATE = 30.0


class RigDidNotStart(RuntimeError):
    """The loopback rig ended, or did not serve in time; holds what it printed."""

    exit_code: ClassVar[int] = 4


@dataclass(frozen=True, slots=True)
class LoopbackRig:
    """A loopback rig that serves; nothing that it presses is a result on paper."""

    config: Path
    """Its rig.toml."""
    folder: Path
    """Where it lies, with the rig's log."""
    process: subprocess.Popen[bytes]

    def fresh_sheet(self) -> None:
        """Put a blank sheet in."""
        self.process.send_signal(signal.SIGUSR1)

    def end(self) -> None:
        """End the rig and wait for it."""
        self.process.terminate()
        self.process.wait()


def start(config: Path, log: Path, *options: str, detached: bool = False) -> LoopbackRig:
    """Start `brushloop sim` and wait until it has written `config`, which must not exist yet.

    Detached, it is not reached by Ctrl-C in this terminal. Raises `RigDidNotStart`.
    """
    command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(config), *options]
    with log.open("ab") as file:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=detached
        )
    rig = LoopbackRig(config, log.parent, process)
    deadline = time.monotonic() + START_S
    while not config.exists():
        if process.poll() is not None or time.monotonic() > deadline:
            rig.end()
            raise RigDidNotStart(f"the loopback rig did not start; {log} says: {log.read_text(errors='replace')}")
        time.sleep(POLL_S)
    return rig


@contextmanager
def simulate(
    folder: Path | None = None, *, rate: float = RATE, seed: int = 1, brush: str = "loopback"
) -> Generator[LoopbackRig]:
    """Serve a loopback rig until the end of the block, `rate` simulated seconds in a real one.

    Its files are kept in `folder`; without one they go with the block. `brush` as for `brushloop sim`. Raises
    `RigDidNotStart`.
    """
    with tempfile.TemporaryDirectory(prefix="brushloop-rig-") as own:
        place = (folder or Path(own)).resolve()
        place.mkdir(parents=True, exist_ok=True)
        config = place / "rig.toml"
        config.unlink(missing_ok=True)  # that of an earlier rig, which no longer serves
        options = ("--rate", str(rate), "--seed", str(seed), "--brush", brush)
        rig = start(config, place / "rig.log", *options)
        try:
            yield rig
        finally:
            rig.end()


TIMEOUT_S = 5.0
GUIDING_S = 120.0
"""Longest wait for an act of the person in the lab."""
MAX_ANSWER_BYTES = 4 * 1024 * 1024


class FaultRefused(Exception):
    """No rig listens, or the rig refused the request."""

    exit_code: ClassVar[int] = 2


def request_of(what: str, kind: str | None, options: Mapping[str, object]) -> dict[str, Any]:
    """The request that the words of a command line ask for; the rig refuses what it does not know."""
    fields = {name: value for name, value in options.items() if value is not None}
    if kind is None:
        return {"do": what, **fields}
    return {"do": "add", "fault": {"device": what, "kind": kind, **fields}}


def ask(path: Path, request: Mapping[str, object]) -> dict[str, Any]:
    """Send a request; return the rig's answer. Raises `FaultRefused`, with one line, if it is missing or a refusal."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(GUIDING_S if request["do"] == "hand" else TIMEOUT_S)
            client.connect(str(path))
            client.sendall(json.dumps(request).encode() + b"\n")
            line = client.makefile("rb").readline(MAX_ANSWER_BYTES)
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
