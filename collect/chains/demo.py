"""`brushloop demo`: the real commands, in order, against a loopback rig in a process of its own.

All files go under one folder. A demo that is killed and started again continues where it stopped, on a new rig with a
blank sheet: what a step has finished is on disk.
"""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Generator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from brushloop.calibrate.commands import PROTOCOL as WRITE
from brushloop.calibrate.commands import ValidateRequest, show_work
from brushloop.collect.chains import DemoRequest, LoopRequest, WritingRequest
from brushloop.collect.chains.loop import PAGE as LOOP_PAGE
from brushloop.collect.chains.loop import PROTOCOL as REPLAY
from brushloop.collect.chains.loop import run_loop
from brushloop.collect.chains.writing import PAGE as WRITTEN_PAGE
from brushloop.collect.chains.writing import write
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.open_or_resume import open_sessions
from brushloop.collect.errors import StrokesLeftOut
from brushloop.collect.start import calibrated, collect, finished_session, fitted
from brushloop.drivers.loopback import LoopbackRig, start
from brushloop.sessions.terminal import say

if TYPE_CHECKING:
    from brushloop.calibrate.validate.command import ValidationOutput

CHARACTER = "字"
LOG, BAR = "demo.log", 40
"""The file that gets what the steps print; length of a full bar, in characters."""
RATE, SEED = 100.0, 1
"""Simulated seconds per real second; seed of the rig, of the order of presses, and of the loop."""
IDLE_EXIT_S = 180.0
"""Time after which the rig of a killed demo ends; the evaluation between two collections takes less."""
FPS = 24
"""Pictures per real second: a photograph waits for several, and the delay of a faster camera is known sooner."""


@dataclass(frozen=True, slots=True)
class Size:
    """How much a demo does."""

    depths_mm: tuple[float, ...]
    tilts_deg: tuple[float, ...]
    again: int
    """Presses that are recovered from their images and made again."""
    writings: int
    """How often the character is written; 0 leaves Table 3 empty."""
    repeats: int = 2
    """Presses per (H, alpha); one sheet holds two."""


QUICK = Size((11.0, 15.0, 20.0), (0.0, 5.0, 10.0), again=6, writings=0)
FULL = Size((11.0, 13.0, 15.0, 17.0, 20.0), (0.0, 5.0, 10.0), again=15, writings=4)


class Demo:
    """Collect, calibrate, press again, write if asked, and validate, all under `out`."""

    def __init__(self, request: DemoRequest, size: Size) -> None:
        self._request, self._size = request, size
        self._config, self._protocol = request.out / "rig.toml", request.out / "protocol.toml"
        self._sessions = request.out / "sessions"
        self._rig: LoopbackRig | None = None
        self._session: Path
        """What the first step collects, for every later step."""
        self._left_out = 0
        self._validated: ValidationOutput

    def run(self) -> None:
        """Run every step, print how well the models predict the strokes and where report and recording lie, and
        open the report if that is asked.

        A session without a report is continued; a new one is started only when the last one has its report. Raises
        `ConfigError`, `SessionError`, `CollectAborted`, and at the end `StrokesLeftOut` if some were left out.
        """
        asked, size = self._request, self._size
        asked.out.mkdir(parents=True, exist_ok=True)
        grid = f'kind = "grid"\ndepths_mm = {list(size.depths_mm)}\ntilts_deg = {list(size.tilts_deg)}\n'
        self._protocol.write_text(f"{grid}repeats = {size.repeats}\nseed = {SEED}\n", encoding="utf-8")
        presses = len(size.depths_mm) * len(size.tilts_deg) * size.repeats
        write = [(f"write {CHARACTER} {size.writings} times", self._write)] if size.writings else []
        # Title of each step, and what does the part of it that is not done yet.
        steps = [
            (f"press {presses} times, photograph, record", self._collect),
            ("calibrate the camera, fit the brush", self._fit),
            (f"recover {size.again} presses from their images and make them again", self._press_again),
            *write,
            ("compare every model with every stroke", self._validate),
        ]
        say(f"Demo on the simulated loopback rig, in {len(steps)} steps.")
        began_s = time.monotonic()
        try:
            for number, (title, run) in enumerate(steps, 1):
                say(f"[{number}/{len(steps)}] {title} ...")
                step_began_s = time.monotonic()
                with nullcontext() if asked.verbose else _logged(asked.out / LOG):
                    run()
                say(f"  ✓   {time.monotonic() - step_began_s:.0f} s")
        finally:
            if self._rig is not None:
                self._rig.end()
        self._say_answer()
        session = self._session
        say("", f"Done in {time.monotonic() - began_s:.0f} s. It was all simulated: nothing here is a result on paper.")
        say(f"Report: {_report(session)}", f"MCAP:   {session / f'{session.name}.mcap'}")
        if asked.show:
            webbrowser.open(_report(session).resolve().as_uri())
        if self._left_out:
            raise StrokesLeftOut(self._left_out)

    def _say_answer(self) -> None:
        """Print how much of the ink is predicted, and what follows."""
        from brushloop.calibrate.compare import NORMAL, TABLE_2  # slow to import
        from brushloop.calibrate.validate.page import headline, verdict

        if (report := self._validated.report) is None:
            return
        say("", f"How much of the ink is predicted (average CSIM; {report.label}):")
        for label, percent in headline(report):
            say(f"  {label:30} {'█' * round(percent / 100 * BAR):{BAR}} {percent:.1f} %")
        if (shapes := report.stat("ccd-bsm", NORMAL)) is not None:
            say(
                "Here, size and place count. The paper compares shapes scaled to one size: by that measure, CCD-BSM as "
                f"published scores {shapes.csim.avg:.1f} %, and {TABLE_2['ccd-bsm'].csim[2]:.1f} % in the paper."
            )
        say(f"Does CCD-BSM predict this brush? {verdict(report)}")

    def _started(self) -> LoopbackRig:
        """The rig of this demo; started, with a blank sheet, where it is first needed. Raises `RigRefused`."""
        if self._rig is None:
            say("the loopback rig starts in the background; its log is rig.log")
            self._config.unlink(missing_ok=True)  # the rig writes its own
            asked = self._request
            options = {"rate": RATE, "seed": SEED, "brush": asked.brush, "fps": FPS, "idle-exit": IDLE_EXIT_S}
            words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
            self._rig = start(self._config, asked.out / "rig.log", *words, detached=True)
        return self._rig

    def _collect(self) -> None:
        earlier = self._sessions.is_dir() and any(self._sessions.iterdir()) and not open_sessions(self._sessions)
        if not self._config.exists():
            self._started()  # a new demo, or one that was killed while its rig started
        session = finished_session(self._sessions, self._config, self._protocol)
        if session is not None and not _report(session).is_file():
            say(f"continuing with {session}: its collection is finished")
            self._session = session
            return
        sheet = 1 if earlier else None
        request = CollectRequest(self._started().config, self._protocol, self._sessions, sheet=sheet, on_screen=False)
        ended = collect(request)
        self._session, self._left_out = Path(ended.folder), ended.given_up

    def _fit(self) -> None:
        calibrated(self._session)
        fitted(self._session)

    def _press_again(self) -> None:
        folder = self._session / "loop"
        if (folder / LOOP_PAGE).is_file():
            return
        self._blank_sheet(folder / REPLAY)
        presses = self._size.again
        run_loop(LoopRequest(self._session, self._config, folder, presses=presses, seed=SEED, sheet=1, tui=False))

    def _write(self) -> None:
        folder = self._session / "written"
        if (folder / WRITTEN_PAGE).is_file():
            return
        self._blank_sheet(folder / "plan" / WRITE)
        repeats = self._size.writings
        write(WritingRequest(CHARACTER, self._config, folder, self._sessions, repeats=repeats, sheet=1, tui=False))

    def _validate(self) -> None:
        from brushloop.calibrate.validate.command import validate  # slow to import

        command = f"brushloop validate {self._session}"
        say(f"$ {command}")
        self._validated = show_work(validate, ValidateRequest((self._session,), command=command))

    def _blank_sheet(self, protocol: Path) -> None:
        """Put a blank sheet in for the session of this protocol, unless that is finished."""
        if protocol.exists() and finished_session(self._sessions, self._config, protocol) is not None:
            return
        if self._rig is not None:
            self._rig.fresh_sheet()
        self._started()


@contextmanager
def _logged(path: Path) -> Generator[None]:
    """Write to this file what is printed within the block; an error says where to read on."""
    with path.open("a", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            yield
        except Exception as error:
            error.add_note(f"The earlier output is in {path}.")
            raise


def _report(session: Path) -> Path:
    return session / "validation" / "report.html"


def demo(request: DemoRequest) -> None:
    """Run the demo, as `Demo.run` does."""
    Demo(request, FULL if request.full else QUICK).run()
