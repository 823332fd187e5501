"""`brushloop demo`: the real commands, in order, against a loopback rig in a process of its own.

All files go under one folder. A demo that is killed and started again continues where it stopped: what a step has
finished is on disk, and the rig's process, which holds the simulated sheet, outlives the demo by some minutes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.writing import PROTOCOL as WRITE
from brushloop.collect.chains.commands import calibrated, collected, finished_session, fitted
from brushloop.collect.chains.demo_rig import DemoRig
from brushloop.collect.chains.loop import PAGE as LOOP_PAGE
from brushloop.collect.chains.loop import PROTOCOL as REPLAY
from brushloop.collect.chains.loop import LoopRequest, run_loop
from brushloop.collect.chains.writing import PAGE as WRITTEN_PAGE
from brushloop.collect.chains.writing import Writing, WritingRequest
from brushloop.collect.engine.open_or_resume import open_sessions
from brushloop.collect.errors import ConfigError
from brushloop.collect.start import CollectRequest
from brushloop.model.generator import SHIPPED_GENERATOR
from brushloop.sessions.terminal import say, show_work

CHARACTER = "字"


@dataclass(frozen=True, slots=True)
class Size:
    """How much a demo does."""

    depths_mm: tuple[float, ...]
    tilts_deg: tuple[float, ...]
    again: int
    """Presses that are recovered from their images and made again."""
    writings: int
    """How often the character is written; 0 leaves Table 3 empty."""

    @property
    def cells(self) -> int:
        """Number of combinations of H and alpha."""
        return len(self.depths_mm) * len(self.tilts_deg)


QUICK = Size((11.0, 15.0, 20.0), (0.0, 5.0, 10.0), again=6, writings=0)
FULL = Size((11.0, 13.0, 15.0, 17.0, 20.0), (0.0, 5.0, 10.0), again=15, writings=4)

# What the steps take on two quiet cores, in seconds, for the announcements.
SESSION_S = 8.0
"""A collection without its strokes: start, camera delay, board, merge."""
STROKE_S, MOTION_S, WRITING_MOTION_S = 0.6, 20.0, 150.0
"""A stroke without its motion; the motion of a press and of a written character, in simulated seconds."""
COMMAND_S, FIT_CELL_S, VALIDATE_CELL_S = 2.0, 0.4, 0.4
"""A command that only computes; fit and validation of one cell of the grid."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the demo; `run` does the part that is not done yet."""

    title: str
    about_s: float
    run: Callable[[], None]


class Demo:
    """Collect, calibrate, press again, write if asked, and validate, all under `out`."""

    def __init__(self, out: Path, size: Size, repeats: int, rate: float, seed: int, brush: Path) -> None:
        self._out = out
        self._size = size
        self._repeats = repeats
        self._rate = rate
        self._seed = seed
        self._protocol, self._sessions = out / "protocol.toml", out / "sessions"
        self._rig = DemoRig(out, rate=rate, seed=seed, brush=brush)
        self._session: Path | None = None
        self._collect_code = 0

    def run(self) -> int:
        """Run every step, and print the paths of the report and of the recording.

        Returns the exit code, 3 if the collection left strokes out. A session without a report is continued; a new one
        is started only when the last one has its report. Raises `ConfigError`, `SessionError`, `CollectAborted`.
        """
        self._out.mkdir(parents=True, exist_ok=True)
        self._write_protocol()
        steps = self._steps()
        total_s = sum(step.about_s for step in steps)
        say(f"Demo on the loopback rig, all simulated: {len(steps)} steps, about {total_s:.0f} s on two quiet cores.")
        began_s = time.monotonic()
        for number, step in enumerate(steps, 1):
            say("", f"[{number}/{len(steps)}] {step.title}: about {step.about_s:.0f} s")
            step_began_s = time.monotonic()
            step.run()
            say(f"[{number}/{len(steps)}] done in {time.monotonic() - step_began_s:.0f} s")
        self._rig.end()
        session = self._finished()
        say("", f"Done in {time.monotonic() - began_s:.0f} s, simulated: nothing here is a result on paper.")
        say(f"Report: {_report(session)}", f"MCAP:   {session / f'{session.name}.mcap'}")
        return self._collect_code

    def _steps(self) -> list[Step]:
        size, presses = self._size, self._size.cells * self._repeats
        press_s = STROKE_S + MOTION_S / self._rate
        steps = [
            Step(f"press {presses} times, photograph, record", SESSION_S + presses * press_s, self._collect),
            Step("calibrate the camera, fit the brush", COMMAND_S + size.cells * FIT_CELL_S, self._fit),
            Step(
                f"recover {size.again} presses from their images and make them again",
                SESSION_S + 3 * COMMAND_S + size.again * press_s,
                self._press_again,
            ),
        ]
        if size.writings:
            writing_s = SESSION_S + 3 * COMMAND_S + size.writings * (STROKE_S + WRITING_MOTION_S / self._rate)
            steps.append(Step(f"write {CHARACTER} {size.writings} times", writing_s, self._write))
        steps.append(
            Step("compare every model with every stroke", COMMAND_S + size.cells * VALIDATE_CELL_S, self._validate)
        )
        return steps

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
        if earlier:
            self._rig.start()
        else:
            self._rig.ready()
        wanted = CollectRequest(self._rig.config, self._protocol, self._sessions, sheet=1 if earlier else None)
        self._collect_code = collected(say, wanted)
        self._session = finished_session(self._sessions, self._rig.config, self._protocol)

    def _fit(self) -> None:
        session = self._finished()
        calibrated(say, session)
        fitted(say, session)

    def _press_again(self) -> None:
        session = self._finished()
        folder = session / "loop"
        if (folder / LOOP_PAGE).is_file():
            return
        self._blank_sheet(folder / REPLAY)
        request = LoopRequest(
            session,
            self._rig.config,
            folder,
            presses=self._size.again,
            seed=self._seed,
            sheet=1,
        )
        run_loop(request, say)

    def _write(self) -> None:
        folder = self._finished() / "written"
        if (folder / WRITTEN_PAGE).is_file():
            return
        self._blank_sheet(folder / "plan" / WRITE)
        request = WritingRequest(
            what=CHARACTER,
            config=self._rig.config,
            out=folder,
            sessions=self._sessions,
            count=self._size.writings,
            sheet=1,
        )
        Writing(request, say).run()

    def _validate(self) -> None:
        from brushloop.calibrate.validate.command import Request, validate  # slow to import

        session = self._finished()
        command = f"brushloop validate {session} --generator {SHIPPED_GENERATOR}"
        say(f"$ {command}")
        show_work(validate, Request(places=(str(session),), command=command, generators=(SHIPPED_GENERATOR,)))

    def _blank_sheet(self, protocol: Path) -> None:
        """Make the rig ready for the session of this protocol, with a blank sheet unless the session has begun."""
        if protocol.exists() and finished_session(self._sessions, self._rig.config, protocol) is not None:
            return
        self._rig.ready()
        if not open_sessions(self._sessions):
            self._rig.fresh_sheet()

    def _finished(self) -> Path:
        if self._session is None:
            raise ConfigError(self._sessions, "", f"holds no finished session of {self._protocol}")
        return self._session


def _report(session: Path) -> Path:
    return session / "validation" / "report.html"
