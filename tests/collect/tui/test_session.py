"""A whole session on the loopback rig through the app: set-up, strokes, trouble, pause, stop, resume, review, close."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from textual.pilot import Pilot

from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.errors import CollectAborted
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.review_screen import ReviewScreen
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.collect.tui.start_screen import SessionBrowser, StartScreen
from brushloop.collect.tui.widgets import AskScreen
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.sessions.recording import Recording, remarks_of
from brushloop.sessions.verify import verify_session
from tests import rigs, runs
from tests.collect.tui.fake import shown
from tests.rigs import SHARP, Lab
from tests.waiting import PATIENCE_S

STROKES = 4
SPLIT = "split"


@dataclass(frozen=True, slots=True)
class Operator:
    """Somebody at the keyboard. The run goes on while the operator waits for it, and stands still while the operator
    looks at the screen."""

    app: OperatorApp
    pilot: Pilot[None]

    @property
    def engine(self) -> Engine:
        assert isinstance(self.app.engine, Engine)
        return self.app.engine

    async def until(self, condition: Callable[[Snapshot], bool]) -> Snapshot:
        return await asyncio.to_thread(runs.until, self.engine, condition)

    async def sees(self, screen: type[object], *words: str) -> None:
        """Wait until this screen shows these words."""
        deadline = time.monotonic() + PATIENCE_S
        while not (isinstance(self.app.screen, screen) and all(word in shown(self.app) for word in words)):
            assert time.monotonic() < deadline, f"waited for {words} on {screen}; it shows:\n{shown(self.app)}"
            await self.pilot.pause(0.02)

    async def press(self, *keys: str) -> None:
        await self.pilot.press(*keys)

    async def is_asked(self, *words: str) -> int:
        """The number of the next question, once the screen shows it and these words."""
        prompt = (await self.until(lambda now: now.prompt is not None)).prompt
        assert prompt is not None
        await self.sees(AskScreen, *words)
        return prompt.number

    async def answers(self, key: str, *words: str) -> None:
        """Answer the next question, which is shown with these words."""
        number = await self.is_asked(*words)
        await self.press(key)
        await self.until(lambda now: now.prompt is None or now.prompt.number != number)

    async def accepts(self, title: str) -> None:
        await self.answers("g", f"{title}: all within limits", "g  good, go on")


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
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    """A rig whose set-up is measured, and whose bad strokes are asked about at once."""
    monkeypatch.setattr("brushloop.collect.engine.engine.Engine", runs.SteppedEngine)
    with rigs.wireless_lab(tmp_path, replace(SHARP, force_noise_n=0.0005)) as lab:
        rigs.sharp(lab).edit_rig("", MEASURED)
        lab.write_protocol(tilts="[0.0, 10.0]")
        yield lab


async def test_a_day_at_the_rig(lab: Lab) -> None:
    rig = lab.rig
    browser = SessionBrowser(lab.sessions, lab.folder / "rig.toml", lab.folder / "protocol.toml")
    app = OperatorApp(browser.engine, browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        operator = Operator(app, pilot)

        # the start screen, and a new session: the set-up asks about what each step measured
        await operator.sees(StartScreen, "No session yet")
        await operator.press("n")
        await operator.sees(AskScreen, f"{STROKES} strokes on 1 sheet")
        await operator.press("y")
        await operator.sees(RunScreen)
        await operator.accepts("Camera, board, scale")
        await operator.accepts("Zero touch and plane")
        await operator.is_asked("Self-check: all within limits")
        rig.world.splits[len(rig.world.presses)] = 1.0
        await operator.accepts("Self-check")

        # a stroke comes out badly: the question has its picture, and the answer presses it again
        await operator.is_asked(SPLIT, "r  press the stroke again")
        assert any("\u2801" <= sign <= "\u28ff" for sign in shown(app)), "a picture, as braille with dots"
        bad = operator.engine.snapshot()
        await operator.answers("r", SPLIT)
        await operator.sees(RunScreen)

        # a protective stop in the middle of a press holds the run until a person has released it
        await operator.until(lambda now: now.strokes_done > bad.strokes_done and now.step.startswith("press"))
        rig.arcs.cabinet.safety_stop()
        await operator.is_asked("ProtectiveStop")
        rig.arcs.cabinet.power.safety = SafetyMode.NORMAL
        await operator.answers("g", "ProtectiveStop")
        await operator.sees(RunScreen)

        # pause, look, go on
        await operator.sees(RunScreen, "space Pause")
        await operator.press("space")
        await operator.until(lambda now: now.state is State.PAUSED)
        await operator.sees(RunScreen, "PAUSED", "space Resume")
        await operator.press("space")
        await operator.until(lambda now: now.step.startswith(("dip", "press")))

        # stop, over a review in which no note is typed meanwhile; nothing is left but an open session
        await operator.press("v")
        await operator.sees(ReviewScreen, "red button", "s STOP")
        assert "o Note" not in shown(app)
        await operator.press("o", "s")
        stopped = operator.engine
        await asyncio.to_thread(runs.ended_by, stopped, CollectAborted)
        await operator.sees(ReviewScreen)
        await operator.press("escape")
        await operator.sees(RunScreen, "STOPPED", "Over: q leaves")
        now = stopped.snapshot()
        assert 1 <= now.strokes_done < STROKES
        await operator.press("q")
        if not now.parked:
            await operator.sees(AskScreen)
            await operator.press("y")
        await operator.sees(StartScreen, "▶", "open", f"{now.strokes_done} of {STROKES} planned", "steps")

        # resume: asked first; board seen and paper touched again, not checked again; then, on a fresh sheet, to the end
        await operator.press("enter")
        await operator.sees(RunScreen)
        await operator.is_asked("Resume ", "stopped; the")
        assert operator.engine.snapshot().strokes_done == now.strokes_done, "nothing looks lost while it is asked"
        await operator.answers("g", "Resume ", "g  resume")
        await operator.accepts("Camera, board, scale")
        await operator.accepts("Zero touch and plane")
        await operator.is_asked("Sheet 1 is full", "sheet 2 is in, and blank")
        rig.world.fresh_sheet()
        await operator.answers("g", "Sheet 1 is full")
        await asyncio.to_thread(runs.wait_for_end, operator.engine)
        await operator.sees(AskScreen, "What shall be done next", "a  analyse")
        assert operator.engine.snapshot().strokes_done == STROKES

        # review: one is marked bad with a note
        await operator.press("v")
        await operator.sees(ReviewScreen, f"{STROKES} of {STROKES + 1} count", "photograph")
        await operator.press("b", "o", *"smudge", "enter")
        await operator.sees(ReviewScreen, "smudge")
        await operator.press("escape", "q")
        await operator.sees(StartScreen, "closed")
        while not any("\u2801" <= sign <= "\u28ff" for sign in shown(app)):  # a mark of each condition, as braille
            await pilot.pause(0.02)
        await operator.press("q")

    assert verify_session(lab.session).sound
    strokes = [capture.stroke.stroke_id for capture in Recording(lab.session).captures()]
    assert len(strokes) == len(set(strokes)) == STROKES
    [remark] = remarks_of(lab.session).values()
    assert (remark.note, remark.bad) == ("smudge", True)
