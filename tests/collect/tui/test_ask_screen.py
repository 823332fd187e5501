"""A question on the screen: shown with its answers, answered by a key, gone when it is over."""

from __future__ import annotations

from dataclasses import replace

import pytest

from collect.asking import Choice, Prompt
from collect.states import State
from collect.tui.app import RunApp
from collect.tui.ask import AskScreen
from tests.collect.tui.fake import FakeEngine, picture

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
    async with RunApp(engine).run_test(size=(80, 24)) as pilot:
        await pilot.pause(0.3)
        assert isinstance(pilot.app.screen, AskScreen)
        await pilot.press("q", "z", "g")
        await pilot.pause(0.1)
        assert [call for call in engine.calls if call.startswith("answer")] == ["answer 7 g"]


async def test_the_stop_key_works_over_a_question(engine: FakeEngine) -> None:
    async with RunApp(engine).run_test(size=(80, 24)) as pilot:
        await pilot.pause(0.3)
        await pilot.press("s")
        assert "stop" in engine.calls


async def test_the_question_goes_when_it_is_over_and_the_next_one_comes(engine: FakeEngine) -> None:
    async with RunApp(engine).run_test(size=(80, 24)) as pilot:
        await pilot.pause(0.3)
        engine.now = replace(engine.now, prompt=replace(PROMPT, question="Is there ink?", number=8))
        await pilot.pause(0.5)
        assert isinstance(pilot.app.screen, AskScreen)
        assert pilot.app.screen.prompt.number == 8
        engine.now = replace(engine.now, prompt=None, state=State.RUNNING)
        await pilot.pause(0.5)
        assert not isinstance(pilot.app.screen, AskScreen)
