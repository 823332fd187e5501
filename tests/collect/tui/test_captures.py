"""Captures on the screen: large, in a question, and on the card at the end of a session."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.capture_screen import CaptureScreen
from brushloop.collect.tui.end_screen import EndScreen, contact_sheet
from brushloop.collect.tui.finish_screen import FinishScreen
from brushloop.collect.tui.large import (
    BOTH,
    CAPTURED,
    PREDICTED,
    WHITE,
    difference,
    over_photograph,
)
from brushloop.collect.tui.question_screens import AskScreen, Confirm
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.collect.tui.widgets import KeyBar
from brushloop.sessions.records import Condition
from brushloop.sessions.verify import Verdict
from tests.collect.tui.fake import DONE, SPLIT, TOUCHED, FakeEngine, capture, full_picture, marked_grid, picture
from tests.collect.tui.fake_browser import FakeReview
from tests.collect.tui.screen_text import has_picture, look


async def test_enter_shows_the_last_capture_large_with_the_missed_check_first() -> None:
    engine = FakeEngine(full_picture(last=capture(kept=False)))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        await look(app, pilot)
        await pilot.press("enter")
        text = await look(app, pilot)
        assert isinstance(app.screen, CaptureScreen)
        assert text.index("! split") < text.index("✓ exposure")
        for part in ("0.42  ≤ 0.30 mm", "The tip is split.", "CSIM 73.2 % in mm", "predicted only", "s STOP"):
            assert part in text
        assert has_picture(text)
        await pilot.press("1", "left", "right", "s", "escape")
        assert isinstance(app.screen, RunScreen)
        assert engine.calls == ["stop"]


async def test_keys_and_the_last_capture_can_be_clicked() -> None:
    engine = FakeEngine(full_picture())
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        await look(app, pilot)
        assert await pilot.click(KeyBar, offset=(2, 0))
        await pilot.click(KeyBar, offset=(9, 0))
        assert engine.calls == ["stop", "pause"]
        await pilot.click("#photo")
        await look(app, pilot)
        assert isinstance(app.screen, CaptureScreen)


def test_a_difference_has_four_colours_and_an_overlay_the_line_of_the_prediction() -> None:
    captured, predicted = np.zeros((128, 128), bool), np.zeros((128, 128), bool)
    captured[40:60, 40:80] = predicted[50:70, 40:80] = True
    pixels = difference(captured, predicted)
    assert [tuple(pixels[y, 60].tolist()) for y in (10, 45, 55, 65)] == [WHITE, CAPTURED, BOTH, PREDICTED]
    over = over_photograph(np.full((500, 500), 255, np.uint8), predicted)
    line = (over == PREDICTED).all(axis=-1)
    assert 0 < line.mean() < 0.05
    assert not line[:140].any()


async def test_a_finished_session_is_shown_on_a_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brushloop.collect.tui.captures.Review", lambda folder: FakeReview(folder.parent))
    monkeypatch.setattr("brushloop.collect.tui.finish_screen.verify", lambda _folder: Verdict("s", "closed"))
    folder = str(tmp_path / "2026-11-21-grid-01")
    engine = FakeEngine(picture(folder=folder))
    app = OperatorApp(engine, again=lambda _session_id: engine)
    async with app.run_test(size=(80, 24)) as pilot:
        await look(app, pilot)
        assert not isinstance(app.screen, EndScreen)
        engine.now = replace(DONE, folder=folder, grid=marked_grid(), elapsed_s=3600.0)
        await look(app, pilot)
        await app.workers.wait_for_complete()
        text = await look(app, pilot)
        for part in (
            "grid-01 is complete",
            "30 of 30",
            "60:00 since the start",
            "mean CSIM 0.914 of 9 presses in 1 cell",
        ):
            assert part in text
        assert has_picture(text)
        await pilot.press("f")
        await look(app, pilot)
        assert isinstance(app.screen, FinishScreen)


def test_a_contact_sheet_has_a_mark_of_each_cell_cut_to_the_ink() -> None:
    small, large = np.zeros((128, 128), bool), np.zeros((128, 128), bool)
    small[60:64, 60:70] = large[50:70, 60:100] = True
    sheet = contact_sheet({Condition(11.0, 0.0): small, Condition(13.0, 0.0): large, Condition(13.0, 10.0): small})
    assert sheet.shape == (2 * (20 + 8), 2 * (40 + 8))
    assert sheet[4 + 10, 4:14].all()
    assert not sheet[28:, :48].any(), "not pressed"
    assert not contact_sheet({Condition(11.0, 0.0): np.zeros((8, 8), bool)}).any()


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
