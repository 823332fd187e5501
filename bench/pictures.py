"""`python -m bench.pictures screens|first-day|frames|report REPORT.html`: the pictures of the documentation.

`screens` are those of a session that the loopback rig really runs, in the operator's app, and a moving picture made of
them; `first-day` those of a first day in an unknown lab: the wizard is the real one, the person's hand is that of the
simulated lab, and every answer is pressed as a key. Both are textual's own SVG export. `frames` shows what H, alpha and
heading are. `report` is the top of a report, drawn by headless Chromium. All but `frames` show the loopback rig.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
from textual.app import App
from textual.pilot import Pilot

import brushloop
from bench.harness import ROOT
from brushloop.collect.commission.visit import Visit
from brushloop.collect.commission.wizard import Wizard
from brushloop.collect.engine.control import State
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Prompt
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.capture_screen import CaptureScreen
from brushloop.collect.tui.commission_app import CommissionApp
from brushloop.collect.tui.review_screen import ReviewScreen
from brushloop.collect.tui.start_screen import SessionBrowser, StartScreen
from brushloop.collect.tui.widgets import AskScreen
from brushloop.drivers.host import Clock
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.lab import UnknownLab
from brushloop.drivers.sim.rig import LoopbackRig

FOLDER = ROOT / "docs" / "screens"
REPORT = ROOT / "docs" / "report.png"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WINDOW_PX, MOST_S = (900, 1150), 120.0
SIZE = (120, 40)
RATE, WAIT_S = 20.0, 120.0
PROTOCOL = 'kind = "grid"\ndepths_mm = [11.0, 13.0, 15.0]\ntilts_deg = [0.0, 10.0]\nrepeats = 2\nseed = 1\n'
DAY_SIZE, DAY_SEED, DAY_RATE = (120, 34), 3, 4.0
DAY_WAIT_S = 1800.0
"""Longest time between two questions: the runs of the proof ask nothing while the brush feels for the paper."""
PICTURES = {
    "address of the cabinet": "arm",
    "hold the second print": "camera",
    "touch 3": "tip",
    "upper right corner of the sheet": "sheet",
    "middle of the well": "places",
    "l: length": "brush",
    "push the tip": "force",
    "in this box": "limits",
    "dry run": "proof",
}
"""Words of a question, in small letters, and the picture that is taken of it."""
SCREENS = ("start", "set-up-camera", "set-up-self-check", "ask", "run", "end")
"""In the order of a session; all of them have one size."""
SECONDS_EACH = 2.0
MOVING = FOLDER / "session.svg"
SVG = re.compile(r"<svg[^>]*viewBox=\"([^\"]+)\"[^>]*>(.*)</svg>\s*$", re.S)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.pictures", description="Draw the pictures of docs/.")
    parser.add_argument("what", choices=("screens", "first-day", "frames", "report"))
    parser.add_argument("page", nargs="?", type=Path, default=Path("report.html"), help="report.html, for `report`")
    options = parser.parse_args(arguments)
    if options.what == "frames":
        frames_picture(ROOT / "docs" / "frames.svg")
        return 0
    if options.what == "report":
        try:
            report_picture(options.page, REPORT)
        except FileNotFoundError as error:
            sys.exit(str(error))
        return 0
    # In a folder of its own, so that no picture names one of this machine's.
    with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        if options.what == "screens":
            _screens()
        else:
            lab = UnknownLab(DAY_SEED, rate=DAY_RATE)
            with _serving(lab) as loop:
                asyncio.run(_day(lab, loop))
    return 0


def _screens() -> None:
    rig = LoopbackRig(SimConfig(rate=RATE, view=View(fps=3.0)))
    with _serving(rig):
        browser = SessionBrowser()
        app = OperatorApp(browser.engine, browser=browser)
        try:
            asyncio.run(_tour(app, rig))
        finally:
            if app.engine is not None:
                app.engine.stop()
                with contextlib.suppress(CollectAborted):
                    app.engine.join()
    MOVING.write_text(session_picture(), encoding="utf-8")


@contextlib.contextmanager
def _serving(rig: contextlib.AbstractAsyncContextManager[Any]) -> Iterator[asyncio.AbstractEventLoop]:
    """The loop of a thread of its own that serves the rig until the block ends."""
    ready: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve() -> None:
        over = asyncio.Event()
        async with rig:
            ready.set_result((asyncio.get_running_loop(), over))
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="loopback rig")
    thread.start()
    loop, over = ready.result(timeout=60)
    try:
        yield loop
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()


def _save(app: App[None], name: str, title: str) -> None:
    (FOLDER / f"{name}.svg").write_text(app.export_screenshot(title=title), encoding="utf-8")
    sys.stdout.write(f"{name}.svg\n")


class _Tour:
    """Presses keys, waits for what is to be seen, and takes pictures."""

    def __init__(self, app: OperatorApp, pilot: Pilot[None]) -> None:
        self.app, self.pilot = app, pilot
        self.asked_split = False

    async def until(self, seen: Callable[[], bool]) -> None:
        deadline = time.monotonic() + WAIT_S
        while not seen():
            if time.monotonic() > deadline:
                now = None if self.app.engine is None else self.app.engine.snapshot().prompt
                raise TimeoutError(f"never seen; the screen is {self.app.screen}, the question {now}")
            await self._answer()
            await self.pilot.pause(0.05)
        await self.pilot.pause(0.4)

    async def _answer(self) -> None:
        """Answer every question that no picture shows: a pale stroke is kept, a late frame taken again."""
        asked = None if self.app.engine is None else self.app.engine.snapshot().prompt
        if asked is None or not isinstance(self.app.screen, AskScreen):
            return
        if Flaw.SPLIT in asked.question and not self.asked_split:
            return
        for words, key in (("it counts", "g"), ("try again", "g")):
            if words in str(asked.choices):
                await self.pilot.press(key)
                await self.pilot.pause(0.2)

    async def take(self, name: str) -> None:
        await self.pilot.pause(0.3)
        _save(self.app, name, f"brushloop, loopback rig: {name}")

    def asked(self, words: str) -> bool:
        now = None if self.app.engine is None else self.app.engine.snapshot()
        return now is not None and now.prompt is not None and words in now.prompt.question

    def strokes(self) -> int:
        return 0 if self.app.engine is None else self.app.engine.snapshot().strokes_done


async def _tour(app: OperatorApp, rig: LoopbackRig) -> None:
    rig_toml, protocol = Path("rig.toml"), Path("protocol.toml")
    rig_toml.write_text(rig.toml() + "\n[quality]\nretakes = 0\n[self_check]\nenabled = true\n", encoding="utf-8")
    protocol.write_text(PROTOCOL, encoding="utf-8")
    async with app.run_test(size=SIZE) as pilot:
        tour = _Tour(app, pilot)
        await tour.take("start")
        await pilot.press("n")
        await app.workers.wait_for_complete()
        await pilot.press("y")
        await tour.until(lambda: tour.asked("Camera"))
        await tour.take("set-up-camera")
        await pilot.press("g")
        await tour.until(lambda: tour.asked("Zero touch"))
        await pilot.press("b")
        for touch in range(3):
            await tour.until(lambda: tour.asked("+2.0"))
            await pilot.press("1")
            await tour.until(lambda: tour.asked("+1.0"))
            if touch == 0:
                await tour.take("set-up-jog")
            await pilot.press("1")
            await tour.until(lambda: tour.asked(" +0.0") or tour.asked(" -0.0"))
            await pilot.press("t")
        await tour.until(lambda: tour.asked("Zero touch and plane"))
        await pilot.press("g")
        await tour.until(lambda: tour.asked("Self-check: "))
        await tour.take("set-up-self-check")
        begun = len(rig.world.presses)
        rig.world.splits.update(dict.fromkeys(range(begun + 2, begun + 5), 1.0))
        await pilot.press("g")
        await tour.until(lambda: tour.asked(Flaw.SPLIT))
        await tour.take("ask")
        tour.asked_split = True
        await pilot.press("r")
        before = tour.strokes()
        await tour.until(lambda: tour.strokes() > before + 3)
        await tour.take("run")
        await tour.until(lambda: app.engine is not None and app.engine.snapshot().state is State.DONE)
        await tour.until(lambda: isinstance(app.screen, AskScreen))
        await app.workers.wait_for_complete()
        await tour.take("end")
        await pilot.press("escape")
        await pilot.pause(0.3)
        await pilot.press("enter")
        await tour.until(lambda: isinstance(app.screen, CaptureScreen))
        await tour.take("capture")
        await pilot.press("escape", "v")
        await tour.until(lambda: isinstance(app.screen, ReviewScreen))
        await pilot.press("down")
        await pilot.pause(1.0)
        await app.workers.wait_for_complete()
        await tour.take("review")
        await pilot.press("escape", "q")
        await tour.until(lambda: isinstance(app.screen, StartScreen))
        await tour.take("start-after")
        await pilot.press("q")


class _Person:
    """Reads each question, does by hand what it asks for, and presses keys."""

    def __init__(
        self, app: CommissionApp, pilot: Pilot[None], lab: UnknownLab, loop: asyncio.AbstractEventLoop
    ) -> None:
        self._app, self._pilot, self._lab, self._loop = app, pilot, lab, loop
        self._streams = itertools.cycle(lab.streams)
        self._number = 0
        self._held = 0

    async def question(self) -> Prompt | None:
        """The next question; None once the day is over."""
        deadline = time.monotonic() + DAY_WAIT_S
        while time.monotonic() < deadline:
            await self._pilot.pause(0.2)
            if self._app.steps.outcome.done():
                return None
            prompt = self._app.first_day.prompt
            if prompt is not None and prompt.number > self._number:
                self._number = prompt.number
                await self._pilot.pause(0.5)
                return prompt
        raise TimeoutError(f"no question in {DAY_WAIT_S:g} s")

    async def answer(self, prompt: Prompt) -> None:
        """Answer it as somebody would who reads it for the first time."""
        if prompt.thing:
            await self._bring(prompt.thing)
            await self._pilot.press("enter")
        elif prompt.read is not None:
            for letter in self._typed(prompt.question.lower()):
                await self._pilot.press(letter)
            await self._pilot.press("enter")
        else:
            await self._pilot.press(self._chosen(prompt))

    async def _bring(self, thing: str) -> None:
        kind, index, *corner = thing.split(" ", 2)
        number = self._held if kind == "hold-board" else int(index)
        self._held += kind == "hold-board"
        act = self._lab.bring(kind, number, *corner)
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(act, self._loop))

    def _typed(self, words: str) -> str:
        if "stream" in words:
            return next(self._streams)
        lab, facts = self._lab, self._lab.facts
        table, brush = facts.config.table, facts.config.brush
        answers = {
            "address of the cabinet": lab.host,
            "squares of the print": "{}x{}".format(*table.board_squares),
            "side of a square": f"{facts.printed_mm[0]:g}",
            "side of a marker": f"{facts.printed_mm[1]:g}",
            "r: radius": f"{brush.radius_mm:g}",
            "l: length": f"{brush.length_mm:g}",
            "can bus": lab.can_bus,
            "serial line": lab.ink_path,
        }
        return next((answer for part, answer in answers.items() if part in words), "")

    def _chosen(self, prompt: Prompt) -> str:
        """The key that lets the arm move, what fills the well, and yes to what is offered; otherwise no."""
        if "moves by itself" in prompt.question:
            return "a"
        if "well filled" in prompt.question:
            return {"station": "i", "pump": "p", "none": "n"}[self._lab.facts.config.ink_device]
        return "enter" if prompt.default else "y" if prompt.question.endswith(("Agreed?", "0 kg?")) else "n"


async def _day(lab: UnknownLab, loop: asyncio.AbstractEventLoop) -> None:
    visit, taken = Visit(Path("rig.toml"), Clock(), armed=True), set[str]()
    app = CommissionApp(visit, lambda: Wizard(visit).run())
    async with app.run_test(size=DAY_SIZE) as pilot:
        person = _Person(app, pilot, lab, loop)
        while (prompt := await person.question()) is not None:
            if prompt.question.startswith("How do you want to go on"):
                raise RuntimeError(visit.findings[-1][1])
            words = prompt.question.lower()
            for name in (name for part, name in PICTURES.items() if part in words and name not in taken):
                taken.add(name)
                _save(app, f"first-day-{name}", f"brushloop rig new, loopback rig: {name}")
            sys.stdout.write(f"{prompt.question}\n")
            await person.answer(prompt)
    app.steps.outcome.result()


def session_picture() -> str:
    """The pictures of `SCREENS`, which have one size and ids of their own, in a loop; the last stays twice as long.

    Where the reader has asked for less motion, it is the last picture alone.
    """
    parts = [SVG.search((FOLDER / f"{name}.svg").read_text(encoding="utf-8")) for name in SCREENS]
    turns, box, frames = len(SCREENS) + 1, "", list[str]()
    for place, part in enumerate(parts):
        assert part is not None, "each has a viewBox"
        box = part[1]
        frames.append(f'<g class="frame" style="animation-delay:{place * SECONDS_EACH:g}s">{part[2]}</g>')
    lasts = (100.0 / turns, 200.0 / turns)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}"><style>'
        f"@keyframes turn{{0%{{visibility:visible}}{lasts[0]:.3f}%{{visibility:hidden}}}}"
        f"@keyframes last{{0%{{visibility:visible}}{lasts[1]:.3f}%{{visibility:hidden}}}}"
        f".frame{{visibility:hidden;animation:turn {turns * SECONDS_EACH:g}s step-end infinite}}"
        ".frame:last-child{animation-name:last}"
        "@media (prefers-reduced-motion:reduce){.frame{animation:none}.frame:last-child{visibility:visible}}"
        f"</style>{''.join(frames)}</svg>\n"
    )


def frames_picture(out: Path) -> None:
    """Draw a press from the side and its mark from above, with H, alpha, heading and the axes of the paper."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    condition, heading, length_mm = brushloop.Condition(depth_mm=15.0, tilt_deg=20.0), np.radians(30.0), 48.0
    lean, tip_mm = np.radians(condition.tilt_deg), np.array([0.0, -condition.depth_mm])
    mpl.rcParams["svg.hashsalt"] = out.name  # equal pictures are equal files
    figure: Any = Figure(figsize=(9.0, 4.4), layout="constrained")
    side, above = figure.subplots(1, 2)
    side.plot([-20.0, 40.0], [0.0, 0.0], color="black", label="paper")
    side.plot([0.0, 0.0], [0.0, length_mm], "--", color="0.5", label="zero touch: the upright tip just touches")
    axis_mm = np.array([tip_mm, tip_mm + length_mm * np.array([np.sin(lean), np.cos(lean)])])
    side.plot(*axis_mm.T, color="C0", lw=4, label="press: H deeper, tilted by α")
    side.annotate("", (-5.0, 0.0), (-5.0, tip_mm[1]), arrowprops={"arrowstyle": "<->"})
    side.text(-11.0, -10.0, "H", fontsize=14)
    side.text(2.5, 18.0, "α", fontsize=14)
    ahead, aside = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    edge_mm = brushloop.predict(condition).outline_mm @ np.array([ahead, aside])
    above.fill(*(edge_mm + condition.depth_mm * np.tan(lean) * ahead).T, color="0.8", label="mark by CCD-BSM")
    above.plot(0.0, 0.0, "o", color="C0", label="anchor, where the upright tip touches")
    for name, tip in (("x", [30.0, 0.0]), ("y", [0.0, 30.0]), ("heading: the ferrule leans there", 30.0 * ahead)):
        above.annotate("", tip, (0.0, 0.0), arrowprops={"arrowstyle": "->", "shrinkA": 0})
        above.text(*np.multiply(1.06, tip), name, fontsize=11, va="center")
    for axes, title, low in ((side, "from the side", -25.0), (above, "from above, in the axes of the paper", -30.0)):
        axes.set(title=title, aspect="equal", xlim=(low, low + 75.0), ylim=(-20.0, 50.0))
        axes.axis("off")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.02), frameon=False)
    figure.savefig(out, metadata={"Date": None})


def find_browser() -> str | None:
    """Path of an installed Chromium; None without one."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def report_picture(report: Path, out: Path) -> None:
    """Draw the top of the page. Raises FileNotFoundError without a browser or page, subprocess errors if it fails."""
    browser = find_browser()
    if browser is None:
        raise FileNotFoundError(f"none of {', '.join(BROWSERS)} is installed")
    if not report.is_file():
        raise FileNotFoundError(f"{report}: no such file")
    with tempfile.TemporaryDirectory() as profile:
        size = ",".join(map(str, WINDOW_PX))
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={profile}"]
        drawn = [f"--window-size={size}", f"--screenshot={out.resolve()}", report.resolve().as_uri()]
        subprocess.run([browser, *options, *drawn], check=True, capture_output=True, timeout=MOST_S)


if __name__ == "__main__":
    sys.exit(main())
