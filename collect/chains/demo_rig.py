"""The loopback rig of `brushloop demo`, in a process of its own that outlives the demo by some minutes.

It holds the simulated sheet: a demo that is killed and started again finds its strokes where they were.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.drivers.loopback import LoopbackRig, ask, start

IDLE_EXIT_S = 180.0
"""Longer than the evaluation between two collections takes on a busy computer."""
FPS = 12
"""Pictures per second: a photograph waits for several. Drawing and decoding more would cost what they save."""
MAX_CONTROL_BYTES = 100


class DemoRig:
    """Starts the rig, or finds the one of an earlier demo in the same folder."""

    def __init__(self, folder: Path, *, rate: float, seed: int, brush: Path) -> None:
        self.config = folder / "rig.toml"
        self._folder = folder
        self._rate = rate
        self._seed = seed
        self._brush = brush
        self._started: LoopbackRig | None = None

    def start(self) -> None:
        """Start a rig with a blank sheet, on new ports. Raises `RigDidNotStart`, `ConfigError`."""
        self._serve(_free_port(), _free_port())

    def ready(self) -> None:
        """Go on with the rig that `rig.toml` names; start it on the same ports, with a blank sheet, if it has ended.

        Raises `RigDidNotStart` and `ConfigError`.
        """
        if not self.config.exists():
            self.start()
            return
        known = load_rig(self.config)
        ports = known.robot.port, _camera_port(known)
        if not all(map(_listens, ports)):
            self._serve(*ports)

    def fresh_sheet(self) -> None:
        """Put a blank sheet in. Raises `FaultRefused`."""
        ask(self._control(load_rig(self.config).robot.port), {"do": "fresh-sheet"})

    def end(self) -> None:
        """End the rig if this process started it; one that an earlier demo started ends by itself when idle."""
        if self._started is not None:
            self._started.end()

    def _serve(self, arcs_port: int, camera_port: int) -> None:
        options = ["--rate", str(self._rate), "--fps", str(FPS), "--seed", str(self._seed), "--brush", str(self._brush)]
        options += ["--arcs-port", str(arcs_port), "--camera-port", str(camera_port)]
        options += ["--control", str(self._control(arcs_port)), "--idle-exit", str(IDLE_EXIT_S)]

        def serves() -> bool:
            return _listens(arcs_port) and _listens(camera_port) and _names(self.config, arcs_port)

        self._started = start(self.config, self._folder / "rig.log", *options, serves=serves, detached=True)

    def _control(self, arcs_port: int) -> Path:
        """The control socket of the rig on that port. Raises `ConfigError` where its path would be too long."""
        path = self._folder / f"rig-{arcs_port}.sock"
        path = min(path, Path(os.path.relpath(path)), key=lambda one: len(os.fsencode(one)))
        if len(os.fsencode(path)) > MAX_CONTROL_BYTES:
            raise ConfigError(
                path, "", f"is too long for a socket, at most {MAX_CONTROL_BYTES} bytes: use another --out"
            )
        return path


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _names(rig_toml: Path, arcs_port: int) -> bool:
    return rig_toml.exists() and f"port = {arcs_port}\n" in rig_toml.read_text(encoding="utf-8")


def _camera_port(rig: RigConfig) -> int:
    return int(rig.camera.source.split(":")[2].split("/")[0])
