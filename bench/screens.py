"""`python -m bench.screens [OUT]`: pictures of every screen, of a session that the loopback rig really runs.

Textual's own SVG export; nothing is drawn by hand. They show the loopback rig, and say so.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

from textual.pilot import Pilot

from bench.moving import write_moving
from brushloop.collect.engine.control import State
from brushloop.collect.errors import CollectAborted
from brushloop.collect.start import engine_for
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.browser import Paths, SessionBrowser
from brushloop.collect.tui.capture_screen import CaptureScreen
from brushloop.collect.tui.end_screen import EndScreen
from brushloop.collect.tui.finish_screen import FinishScreen
from brushloop.collect.tui.question_screens import AskScreen
from brushloop.collect.tui.review_screen import ReviewScreen
from brushloop.collect.tui.start_screen import StartScreen
from brushloop.drivers.sim.brush.flaws import Flaw
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import LoopbackRig

SIZE = (120, 40)
SMALL = (80, 24)
RATE = 20.0
WAIT_S = 120.0
PROTOCOL = 'kind = "grid"\ndepths_mm = [11.0, 13.0, 15.0]\ntilts_deg = [0.0, 10.0]\nrepeats = 2\nseed = 1\n'


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.screens", description="Render every screen as SVG.")
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/screens"))
    out: Path = parser.parse_args(arguments).out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    # In a folder of its own, so that no picture names one of this machine's.
    with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch), _serving() as rig:
        app = OperatorApp(browser=SessionBrowser(Paths(), engine_for))
        try:
            asyncio.run(_tour(app, rig, out))
        finally:
            if app.engine is not None:
                app.engine.stop()
                with contextlib.suppress(CollectAborted):
                    app.engine.join()
    write_moving(out)
    return 0


@contextmanager
def _serving() -> Iterator[LoopbackRig]:
    ready: Future[tuple[LoopbackRig, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve() -> None:
        over = asyncio.Event()
        async with LoopbackRig(SimConfig(rate=RATE, view=View(fps=3.0))) as rig:
            ready.set_result((rig, asyncio.get_running_loop(), over))
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="loopback rig")
    thread.start()
    rig, loop, over = ready.result(timeout=60)
    try:
        yield rig
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()


class _Tour:
    """Presses keys, waits for what is to be seen, and takes pictures."""

    def __init__(self, app: OperatorApp, pilot: Pilot[None], out: Path) -> None:
        self.app, self.pilot, self._out = app, pilot, out
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
        path = self._out / f"{name}.svg"
        path.write_text(self.app.export_screenshot(title=f"brushloop, loopback rig: {name}"), encoding="utf-8")
        sys.stdout.write(f"{path.name}\n")

    def asked(self, words: str) -> bool:
        now = None if self.app.engine is None else self.app.engine.snapshot()
        return now is not None and now.prompt is not None and words in now.prompt.question

    def strokes(self) -> int:
        return 0 if self.app.engine is None else self.app.engine.snapshot().strokes_done


async def _tour(app: OperatorApp, rig: LoopbackRig, out: Path) -> None:
    rig_toml, protocol = Path("rig.toml"), Path("protocol.toml")
    rig_toml.write_text(rig.toml() + "\n[quality]\nretakes = 0\n[self_check]\nenabled = true\n", encoding="utf-8")
    protocol.write_text(PROTOCOL, encoding="utf-8")
    async with app.run_test(size=SIZE) as pilot:
        tour = _Tour(app, pilot, out)
        await pilot.press("d")
        await app.workers.wait_for_complete()
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
        rig.world.flaws.update(dict.fromkeys(range(begun + 2, begun + 5), (Flaw.SPLIT, 1.0)))
        await pilot.press("g")
        await tour.until(lambda: tour.asked(Flaw.SPLIT))
        await tour.take("ask")
        tour.asked_split = True
        await pilot.press("r")
        before = tour.strokes()
        await tour.until(lambda: tour.strokes() > before + 3)
        await tour.take("run")
        await pilot.resize_terminal(*SMALL)
        await tour.take("run-80x24")
        await pilot.press("tab")
        await tour.take("capture-80x24")
        await pilot.press("question_mark")
        await tour.take("help-80x24")
        await pilot.press("escape")
        await pilot.resize_terminal(*SIZE)
        await tour.until(lambda: app.engine is not None and app.engine.snapshot().state is State.DONE)
        await tour.until(lambda: isinstance(app.screen, EndScreen))
        await app.workers.wait_for_complete()
        await tour.take("end")
        await pilot.press("escape")
        await tour.take("done")
        await pilot.press("enter")
        await tour.until(lambda: isinstance(app.screen, CaptureScreen))
        await tour.take("capture")
        await pilot.press("escape", "v")
        await tour.until(lambda: isinstance(app.screen, ReviewScreen))
        await pilot.press("down")
        await pilot.pause(1.0)
        await app.workers.wait_for_complete()
        await tour.take("review")
        await pilot.press("f")
        await tour.until(lambda: isinstance(app.screen, FinishScreen))
        await app.workers.wait_for_complete()
        await tour.take("finish")
        await pilot.press("escape", "escape", "q")
        await tour.until(lambda: isinstance(app.screen, StartScreen))
        await tour.take("start-after")
        await pilot.press("q")


if __name__ == "__main__":
    sys.exit(main())
