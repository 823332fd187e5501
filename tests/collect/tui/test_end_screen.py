"""The card at the end of a session."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.end_screen import EndScreen, alike_text, contact_sheet
from brushloop.collect.tui.finish_screen import FinishScreen
from brushloop.sessions.records import Condition
from brushloop.sessions.verify import Verdict
from tests.collect.tui.fake import DONE, FakeEngine, marked_grid, picture
from tests.collect.tui.fake_browser import FakeReview
from tests.collect.tui.screen_text import has_picture, look


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


def test_repeatability_is_the_mean_of_the_cells() -> None:
    assert alike_text([(0.9, 3), (0.8, 9)]) == "mean CSIM 0.850 of 12 presses in 2 cells"
    assert alike_text([]) == "no cell was pressed twice"
