"""`brushloop demo`: the real commands, in order, against a loopback rig in a process of its own.

All files go under one folder. A demo that is killed and started again continues where it stopped: what a step has
finished is on disk, and the rig's process, which holds the simulated sheet, outlives the demo by some minutes.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.commands import ValidateRequest, show_work
from brushloop.calibrate.writing import PROTOCOL as WRITE
from brushloop.collect.chains.commands import calibrated, collected, finished_session, fitted
from brushloop.collect.chains.loop import PAGE as LOOP_PAGE
from brushloop.collect.chains.loop import PROTOCOL as REPLAY
from brushloop.collect.chains.loop import LoopRequest, run_loop
from brushloop.collect.chains.writing import PAGE as WRITTEN_PAGE
from brushloop.collect.chains.writing import Writing, WritingRequest
from brushloop.collect.engine.open_or_resume import open_sessions
from brushloop.collect.rig.config import load_rig
from brushloop.collect.start import CollectRequest
from brushloop.drivers.loopback import FaultRefused, LoopbackRig, ask, start
from brushloop.model.generator import SHIPPED_GENERATOR
from brushloop.sessions.terminal import say

CHARACTER = "字"
LEFT_OUT_CODE = 3
"""Exit code of a demo whose collection finished but left strokes out."""
IDLE_EXIT_S = 180.0
"""Longer than the evaluation between two collections takes on a busy computer."""
FPS = 12
"""Pictures per second: a photograph waits for several. Drawing and decoding more would cost what they save."""


@dataclass(frozen=True, slots=True)
class Size:
    """How much a demo does."""

    depths_mm: tuple[float, ...]
    tilts_deg: tuple[float, ...]
    again: int
    """Presses that are recovered from their images and made again."""
    writings: int
    """How often the character is written; 0 leaves Table 3 empty."""


QUICK = Size((11.0, 15.0, 20.0), (0.0, 5.0, 10.0), again=6, writings=0)
FULL = Size((11.0, 13.0, 15.0, 17.0, 20.0), (0.0, 5.0, 10.0), again=15, writings=4)


class DemoRig:
    """The loopback rig of a demo, started or found in the demo's folder."""

    def __init__(self, folder: Path, *, rate: float, seed: int, brush: Path) -> None:
        self.config = folder / "rig.toml"
        self._folder = folder
        self._options = ["--rate", str(rate), "--seed", str(seed), "--brush", str(brush)]
        self._started: LoopbackRig | None = None

    def start(self) -> None:
        """Start a rig with a blank sheet, on a new port. Raises `RigDidNotStart`."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])

        def serves() -> bool:
            # An earlier rig may have left its rig.toml here.
            return self.config.exists() and f"port = {port}\n" in self.config.read_text(encoding="utf-8")

        options = [*self._options, "--fps", str(FPS), "--idle-exit", str(IDLE_EXIT_S)]
        options += ["--arcs-port", str(port), "--control", str(self._control(port))]
        self._started = start(self.config, self._folder / "rig.log", *options, serves=serves, detached=True)

    def ready(self) -> None:
        """Go on with the rig that `rig.toml` names; start one with a blank sheet if it has ended.

        Raises `RigDidNotStart` and `ConfigError`.
        """
        if not self.config.exists():
            self.start()
            return
        try:
            self._ask("state")
        except FaultRefused:
            self.start()

    def fresh_sheet(self) -> None:
        """Put a blank sheet in. Raises `FaultRefused`, and `ConfigError` for a bad rig.toml."""
        self._ask("fresh-sheet")

    def end(self) -> None:
        """End the rig if this process started it; one that an earlier demo started ends by itself when idle."""
        if self._started is not None:
            self._started.end()

    def _ask(self, what: str) -> None:
        ask(self._control(load_rig(self.config).robot.port), {"do": what})

    def _control(self, arcs_port: int) -> Path:
        return self._folder / f"rig-{arcs_port}.sock"


class Demo:
    """Collect, calibrate, press again, write if asked, and validate, all under `out`."""

    def __init__(self, out: Path, size: Size, repeats: int, rate: float, seed: int, brush: Path) -> None:
        self._out = out
        self._size = size
        self._repeats = repeats
        self._seed = seed
        self._protocol, self._sessions = out / "protocol.toml", out / "sessions"
        self._rig = DemoRig(out, rate=rate, seed=seed, brush=brush)
        self._session: Path
        """What the first step collects, for every later step."""
        self._exit_code = 0

    def run(self) -> int:
        """Run every step, and print the paths of the report and of the recording.

        Returns the exit code, 3 if the collection left strokes out. A session without a report is continued; a new one
        is started only when the last one has its report. Raises `ConfigError`, `SessionError`, `CollectAborted`.
        """
        self._out.mkdir(parents=True, exist_ok=True)
        self._write_protocol()
        steps = self._steps()
        say(f"Demo on the loopback rig, all simulated: {len(steps)} steps.")
        began_s = time.monotonic()
        for number, (title, run) in enumerate(steps, 1):
            say("", f"[{number}/{len(steps)}] {title}")
            step_began_s = time.monotonic()
            run()
            say(f"[{number}/{len(steps)}] done in {time.monotonic() - step_began_s:.0f} s")
        self._rig.end()
        session = self._session
        say("", f"Done in {time.monotonic() - began_s:.0f} s, simulated: nothing here is a result on paper.")
        say(f"Report: {_report(session)}", f"MCAP:   {session / f'{session.name}.mcap'}")
        return self._exit_code

    def _steps(self) -> list[tuple[str, Callable[[], None]]]:
        """Title of each step, and what does the part of it that is not done yet."""
        size = self._size
        presses = len(size.depths_mm) * len(size.tilts_deg) * self._repeats
        write = [(f"write {CHARACTER} {size.writings} times", self._write)] if size.writings else []
        return [
            (f"press {presses} times, photograph, record", self._collect),
            ("calibrate the camera, fit the brush", self._fit),
            (f"recover {size.again} presses from their images and make them again", self._press_again),
            *write,
            ("compare every model with every stroke", self._validate),
        ]

    def _write_protocol(self) -> None:
        size = self._size
        protocol = (
            f'kind = "grid"\ndepths_mm = {list(size.depths_mm)}\ntilts_deg = {list(size.tilts_deg)}\n'
            f"repeats = {self._repeats}\nseed = {self._seed}\n"
        )
        if not self._protocol.exists() or self._protocol.read_text(encoding="utf-8") != protocol:
            self._protocol.write_text(protocol, encoding="utf-8")

    def _collect(self) -> None:
        session = finished_session(self._sessions, self._rig.config, self._protocol)
        if session is not None and not _report(session).is_file():
            say(f"continuing with {session}: its collection is finished")
            self._session = session
            return
        earlier = self._sessions.is_dir() and any(self._sessions.iterdir()) and not open_sessions(self._sessions)
        say("the loopback rig starts in the background; its log is rig.log")
        (self._rig.start if earlier else self._rig.ready)()
        sheet = 1 if earlier else None
        self._session, left_out = collected(
            CollectRequest(self._rig.config, self._protocol, self._sessions, sheet=sheet)
        )
        self._exit_code = LEFT_OUT_CODE if left_out else 0

    def _fit(self) -> None:
        calibrated(self._session)
        fitted(self._session)

    def _press_again(self) -> None:
        folder = self._session / "loop"
        if (folder / LOOP_PAGE).is_file():
            return
        self._blank_sheet(folder / REPLAY)
        presses, seed = self._size.again, self._seed
        run_loop(LoopRequest(self._session, self._rig.config, folder, presses=presses, seed=seed, sheet=1))

    def _write(self) -> None:
        folder = self._session / "written"
        if (folder / WRITTEN_PAGE).is_file():
            return
        self._blank_sheet(folder / "plan" / WRITE)
        config, count = self._rig.config, self._size.writings
        Writing(WritingRequest(CHARACTER, config, folder, self._sessions, count=count, sheet=1)).run()

    def _validate(self) -> None:
        from brushloop.calibrate.validate.command import validate  # slow to import

        command = f"brushloop validate {self._session} --generator {SHIPPED_GENERATOR}"
        say(f"$ {command}")
        places = (str(self._session),)
        show_work(validate, ValidateRequest(places, command=command, generators=(SHIPPED_GENERATOR,)))

    def _blank_sheet(self, protocol: Path) -> None:
        """Make the rig ready for the session of this protocol, with a blank sheet unless the session has begun."""
        if protocol.exists() and finished_session(self._sessions, self._rig.config, protocol) is not None:
            return
        self._rig.ready()
        if not open_sessions(self._sessions):
            self._rig.fresh_sheet()


def _report(session: Path) -> Path:
    return session / "validation" / "report.html"
