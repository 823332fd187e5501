"""The large view of the last capture, the age of it, and keys under the pointer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brushloop.collect.quality.verdict import Check, Failure
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.capture_screen import CaptureScreen, words_content
from brushloop.collect.tui.large import (
    BOTH,
    CAPTURED,
    PREDICTED,
    WHITE,
    difference,
    limit_text,
    of_last,
    over_photograph,
)
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.collect.tui.text import age_text
from brushloop.collect.tui.widgets import KeyBar
from tests.collect.tui.fake import FakeEngine, capture, full_picture
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


async def test_the_last_capture_says_its_age() -> None:
    now_s = [100.0]
    app = OperatorApp(FakeEngine(full_picture()), now_s=lambda: now_s[0])
    async with app.run_test(size=(120, 40)) as pilot:
        assert "Capture, just now" in await look(app, pilot)
        now_s[0] += 95.0
        assert "Capture, 1 min ago" in await look(app, pilot)
    assert [age_text(age_s) for age_s in (3.0, 29.0, 7200.0)] == ["just now", "20 s ago", "2 h ago"]


def test_a_difference_has_four_colours_and_an_overlay_the_line_of_the_prediction() -> None:
    captured, predicted = np.zeros((128, 128), bool), np.zeros((128, 128), bool)
    captured[40:60, 40:80] = predicted[50:70, 40:80] = True
    pixels = difference(captured, predicted)
    assert [tuple(pixels[y, 60].tolist()) for y in (10, 45, 55, 65)] == [WHITE, CAPTURED, BOTH, PREDICTED]
    over = over_photograph(np.full((500, 500), 255, np.uint8), predicted)
    line = (over == PREDICTED).all(axis=-1)
    assert 0 < line.mean() < 0.05
    assert not line[:140].any()


def test_a_limit_says_on_which_side_the_value_has_to_be() -> None:
    blurred = Check(Failure.BLURRED, 0.11, "mm", 0.25, True, "")
    assert limit_text(blurred) == "≤ 0.25 mm"
    assert limit_text(replace(blurred, score=0.4, passed=False)) == "≤ 0.25 mm"
    assert limit_text(replace(blurred, score=0.4)) == "≥ 0.25 mm"
    assert "not judged" in words_content(of_last(replace(capture(), verdict=None))).plain
