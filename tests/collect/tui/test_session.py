"""A whole session on the loopback rig through the app: set-up, strokes, trouble, pause, stop, resume, review, close."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from textual.pilot import Pilot

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.review_screen import ReviewScreen
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.collect.tui.start_screen import SessionBrowser, StartScreen
from brushloop.collect.tui.widgets import AskScreen
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.sessions.recording import Recording, remarks_of
from brushloop.sessions.verify import verify_session
from tests.collect.tui.fake import has_picture, shown
from tests.rigs import in_thread
from tests.runs import wait_for_end
from tests.waiting import PATIENCE_S

STROKES = 4
SPLIT = "split"
RATE = 40.0


@dataclass(frozen=True, slots=True)
class Operator:
    """Somebody at the keyboard, who waits for what the screen shows."""

    app: OperatorApp
    pilot: Pilot[None]

    def now(self) -> Snapshot:
        assert self.app.engine is not None
        return self.app.engine.snapshot()

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline, looked_s = time.monotonic() + PATIENCE_S, time.thread_time()
        while not condition():
            assert time.monotonic() < deadline, f"{what}; the screen shows:\n{shown(self.app)}"
            await self._answer_what_this_test_is_not_about()
            # Reading the screen takes longer than showing it: it has a tenth of the time at most.
            await asyncio.sleep(max(0.1, 10.0 * (time.thread_time() - looked_s)))
            looked_s = time.thread_time()

    async def _answer_what_this_test_is_not_about(self) -> None:
        """The loopback brush runs dry by itself now and then; on a busy machine a frame may be late."""
        screen = self.app.screen
        asked = screen.prompt if isinstance(screen, AskScreen) else None
        if asked is None or SPLIT in asked.question:
            return
        for words, key in (("it counts", "g"), ("try again", "g")):
            if words in str(asked.choices):
                await self.press(key)
                await self.pilot.pause(0.2)

    async def on(self, screen: type[object]) -> None:
        await self.until(lambda: isinstance(self.app.screen, screen), f"waited for {screen.__name__}")

    async def reads(self, *words: str) -> None:
        for word in words:
            await self.until(lambda word=word: word in shown(self.app), f"waited for {word!r}")

    async def in_state(self, state: State) -> None:
        await self.until(lambda: self.now().state is state, f"waited for {state}")

    async def press(self, *keys: str) -> None:
        """As a keyboard does: without waiting until the screen, which always changes while a run is on, is idle."""
        for key in keys:
            self.app.simulate_key(key)
            await asyncio.sleep(0)

    async def accept(self, title: str) -> None:
        await self.reads(f"{title}: all within limits", "g  good, go on")
        await self.press("g")


MEASURED = """
[quality]
retakes = 0

[touch]
method = "force"
touches = 1

[touch.force]
sigma_mm = 0.3
fast_samples = 5
medium_samples = 10
slow_samples = 25
settle_s = 0.01

[self_check]
enabled = true
"""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[LoopbackRig]:
    """A rig with its files: a camera half as sharp as by default, sharp enough to judge by, and a force sensor that may
    have to wait for the rest of a busy machine. No mark splits by itself."""
    view = View(width_px=1024, height_px=768, px_per_mm=3.125, fps=5.0)
    with in_thread(LoopbackRig(SimConfig(rate=RATE, view=view, force_noise_n=0.0005))) as (rig, _):
        rig.world.flaws.update(dict.fromkeys(range(100), (Flaw.SPLIT, 0.0)))
        text = rig.toml().replace("latency_ms = 250.0", "latency_ms = 1500.0")
        text = text.replace("stale_ms = 1000.0", "stale_ms = 2000.0\nbias_s = 0.25")
        (tmp_path / "rig.toml").write_text(text + MEASURED, encoding="utf-8")
        grid = 'kind = "grid"\ndepths_mm = [11.0, 15.0]\ntilts_deg = [0.0, 10.0]\nrepeats = 1\n'
        (tmp_path / "protocol.toml").write_text(grid, encoding="utf-8")
        yield rig


@pytest.mark.timeout(400)
async def test_a_day_at_the_rig(rig: LoopbackRig, tmp_path: Path) -> None:
    browser = SessionBrowser(tmp_path / "sessions", tmp_path / "rig.toml", tmp_path / "protocol.toml")
    app = OperatorApp(browser.engine, browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        operator = Operator(app, pilot)

        # the start screen, and a new session: the set-up asks about what each step measured
        await operator.reads("No session yet")
        await operator.press("n")
        await operator.reads(f"{STROKES} strokes on 1 sheet")
        await operator.press("y")
        await operator.on(AskScreen)
        await operator.accept("Camera, board, scale")
        await operator.accept("Zero touch and plane")
        await operator.reads("Self-check: all within limits")
        rig.world.flaws[len(rig.world.presses)] = (Flaw.SPLIT, 1.0)
        await operator.accept("Self-check")

        # a stroke comes out badly: the question has its picture, and the answer presses it again
        await operator.reads(SPLIT, "r  press it again")
        await operator.until(lambda: has_picture(shown(app)), "waited for its picture")
        bad = operator.now()
        await operator.press("r")
        await operator.on(RunScreen)

        # a protective stop in the middle of a press holds the run until a person has released it
        await operator.until(lambda: operator.now().strokes_done > bad.strokes_done, "waited for the retake")
        await operator.until(lambda: operator.now().step.startswith("press"), "waited for a press")
        rig.arcs.cabinet.safety_stop()
        await operator.reads("ProtectiveStop")
        rig.arcs.cabinet.power.safety = SafetyMode.NORMAL
        await operator.press("g")
        await operator.on(RunScreen)

        # pause, look, go on
        await operator.reads("space Pause")
        await operator.press("space")
        await operator.in_state(State.PAUSED)
        await operator.reads("PAUSED", "space Resume")
        await operator.press("space")
        await operator.until(lambda: operator.now().step.startswith(("dip", "press")), "waited for the next stroke")

        # stop; nothing is left of it on the start screen but an open session
        await operator.press("s")
        await operator.in_state(State.STOPPED)
        await operator.reads("STOPPED", "Over: q leaves")
        done = operator.now().strokes_done
        assert 1 <= done < STROKES
        parked = operator.now().parked
        await operator.press("q")
        if not parked:
            await operator.on(AskScreen)
            await operator.press("y")
        await operator.on(StartScreen)
        await operator.reads("▶", "open", f"{done} of {STROKES} planned", "steps")

        # resume: asked first; board seen and paper touched again, not checked again; then to the end
        await operator.press("enter")
        await operator.on(AskScreen)
        await operator.reads("Resume ", "stopped; the", "g  resume")
        await operator.press("g")
        await operator.accept("Camera, board, scale")
        await operator.accept("Zero touch and plane")
        await operator.in_state(State.DONE)
        await operator.on(AskScreen)
        await operator.reads("What comes next", "brushloop calibrate")
        assert operator.now().strokes_done == STROKES

        # review: one is marked bad with a note
        await operator.press("v")
        await operator.on(ReviewScreen)
        await operator.reads(f"{STROKES} of {STROKES + 1} count", "still")
        await operator.press("b")
        await pilot.press("o", *"smudge", "enter")
        await operator.reads("smudge")
        await operator.press("escape", "q")
        await operator.on(StartScreen)
        await operator.reads("closed")
        await pilot.press("q")
    assert app.engine is not None
    wait_for_end(app.engine)  # pyright: ignore[reportArgumentType]

    [folder] = (tmp_path / "sessions").iterdir()
    assert verify_session(folder).sound
    strokes = [capture.stroke.stroke_id for capture in Recording(folder).captures()]
    assert len(strokes) == len(set(strokes)) == STROKES
    [remark] = remarks_of(folder).values()
    assert (remark.note, remark.bad) == ("smudge", True)
