"""Captures and questions on the screen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.capture_screen import (
    BOTH,
    CAPTURED,
    PREDICTED,
    WHITE,
    CaptureScreen,
    difference,
    over_photograph,
)
from brushloop.collect.tui.question_screens import AskScreen
from brushloop.collect.tui.run_screen import RunScreen
from tests.collect.tui.fake import DONE, SPLIT, TOUCHED, FakeEngine, capture, full_picture, picture
from tests.collect.tui.screen_text import has_picture, look

PROMPT = Prompt(
    "Sheet 1 is full. Put a fresh one in, then go on.",
    (Choice("g", "sheet 2 is in, and blank"), Choice("x", "stop the run")),
    "x",
    number=7,
)


async def test_enter_shows_the_last_capture_large_with_the_missed_check_first() -> None:
    engine = FakeEngine(full_picture(last=capture(kept=False)))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        await look(app, pilot)
        await pilot.press("enter")
        text = await look(app, pilot)
        assert isinstance(app.screen, CaptureScreen)
        assert text.index("! split") < text.index("✓ exposure")
        for part in ("0.42  ≤ 0.30 mm", "The tip is split.", "73.2 % in mm", "predicted only", "s STOP"):
            assert part in text
        assert has_picture(text)
        await pilot.press("1", "left", "right", "s", "escape")
        assert isinstance(app.screen, RunScreen)
        assert engine.calls == ["stop"]


def test_a_difference_has_four_colours_and_an_overlay_the_line_of_the_prediction() -> None:
    captured, predicted = np.zeros((128, 128), bool), np.zeros((128, 128), bool)
    captured[40:60, 40:80] = predicted[50:70, 40:80] = True
    pixels = difference(captured, predicted)
    assert [tuple(pixels[y, 60].tolist()) for y in (10, 45, 55, 65)] == [WHITE, CAPTURED, BOTH, PREDICTED]
    line = (over_photograph(np.full((500, 500), 255, np.uint8), predicted) == PREDICTED).all(axis=-1)
    assert 0 < line.mean() < 0.05
    assert not line[:140].any()


async def test_a_finished_session_offers_what_comes_next() -> None:
    engine = FakeEngine(picture(folder="sessions/2026-11-21-grid-01"))
    app = OperatorApp(engine, again=lambda _session_id: engine)
    async with app.run_test(size=(120, 24)) as pilot:
        await look(app, pilot)
        engine.now = replace(DONE, folder="sessions/2026-11-21-grid-01")
        text = await look(app, pilot)
        for part in ("with sessions/2026-11-21-grid-01", "v  look through", "c  brushloop calibrate", "30/30"):
            assert part in text
        await pilot.press("q")
        assert isinstance(app.screen, RunScreen)


async def test_a_key_answers_the_question_that_is_shown_and_the_next_one_comes() -> None:
    engine = FakeEngine(picture(state=State.ASKING, step="wait for an answer", prompt=PROMPT))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        assert "Waits until it is answered" in await look(app, pilot)
        await pilot.press("z", "escape", "g")
        assert [call for call in engine.calls if call.startswith("answer")] == ["answer 7 g"]
        engine.now = replace(engine.now, prompt=replace(PROMPT, question="Is there ink?", number=8))
        assert "Is there ink?" in await look(app, pilot)
        engine.now = picture()
        assert "RUNNING" in await look(app, pilot)
        assert isinstance(app.screen, RunScreen)


async def test_q_over_a_question_leaves_it_unanswered_and_parks() -> None:
    engine = FakeEngine(picture(state=State.ASKING, prompt=PROMPT))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        assert "q Leave: park the arm" in await look(app, pilot)
        for answer, calls in (("n", []), ("y", ["park"])):
            await pilot.press("q")
            assert isinstance(app.screen, AskScreen)
            assert app.screen.own
            await pilot.press(answer)
            assert engine.calls == calls


@pytest.mark.parametrize(
    ("prompt", "parts"),
    [
        (SPLIT, ("The tip is split", "k  skip it")),
        (TOUCHED, ("0.180 mm  (at most 0.15)", "!   its touches span", "b  measure by jog", "blur 0.9 px  ✓ sharp")),
    ],
)
async def test_a_question_shows_its_picture_what_was_measured_and_the_live_figures(
    prompt: Prompt, parts: tuple[str, ...]
) -> None:
    app = OperatorApp(FakeEngine(full_picture(state=State.ASKING, prompt=prompt)))
    async with app.run_test(size=(80, 36)) as pilot:
        text = await look(app, pilot)
        for part in (*parts, "mm to go"):
            assert part in text
        assert has_picture(text) is (prompt.image is not None)
