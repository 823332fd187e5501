"""A question on the screen: shown with its picture and answers, answered by a key, gone when it is over."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.question_screens import AskScreen, Confirm
from tests.collect.tui.fake import SPLIT, TOUCHED, FakeEngine, full_picture, picture
from tests.collect.tui.screen_text import has_picture, look

PROMPT = Prompt(
    "Sheet 1 is full. Put a fresh one in, then go on.",
    (Choice("g", "sheet 2 is in, and blank"), Choice("x", "stop the run")),
    "x",
    number=7,
)


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine(picture(state=State.ASKING, step="wait for an answer", prompt=PROMPT))


async def test_a_key_answers_the_question_that_is_shown(engine: FakeEngine) -> None:
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        assert "Waits until it is answered" in await look(app, pilot)
        assert isinstance(app.screen, AskScreen)
        await pilot.press("z", "g")
        assert [call for call in engine.calls if call.startswith("answer")] == ["answer 7 g"]


async def test_q_over_a_question_leaves_it_unanswered_and_parks(engine: FakeEngine) -> None:
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        assert "q  leave: park the arm" in await look(app, pilot)
        await pilot.press("q")
        assert isinstance(app.screen, Confirm)
        await pilot.press("n")
        assert isinstance(app.screen, AskScreen)
        await pilot.press("q", "y")
        assert engine.calls == ["park"]


async def test_the_question_goes_when_it_is_over_and_the_next_one_comes(engine: FakeEngine) -> None:
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        await look(app, pilot)
        engine.now = replace(engine.now, prompt=replace(PROMPT, question="Is there ink?", number=8))
        assert "Is there ink?" in await look(app, pilot)
        engine.now = replace(engine.now, prompt=None, state=State.RUNNING)
        await look(app, pilot)
        assert not isinstance(app.screen, AskScreen)


async def test_a_bad_stroke_is_shown_with_its_picture() -> None:
    engine = FakeEngine(picture(state=State.ASKING, prompt=SPLIT))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        text = await look(app, pilot)
        for part in ("The tip is split", "k  skip it"):
            assert part in text
        assert has_picture(text)
        await pilot.press("r")
        assert engine.calls == ["answer 3 r"]


async def test_a_question_of_the_set_up_shows_what_was_measured_and_the_live_figures() -> None:
    engine = FakeEngine(full_picture(state=State.ASKING, prompt=TOUCHED))
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        text = await look(app, pilot)
        assert isinstance(app.screen, AskScreen)
        for part in ("0.180 mm  (at most 0.15)", "!   its touches span", "b  measure by jog", "blur 0.9 px  ✓ sharp"):
            assert part in text
        await pilot.press("b")
        assert engine.calls == ["answer 2 b"]
        engine.now = picture()
        assert "RUNNING" in await look(app, pilot)
