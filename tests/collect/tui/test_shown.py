"""What the run screen shows: literal text, sizes, the grid, marks; and how often it is drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from textual.geometry import Region
from textual.widget import Widget
from textual.widgets import Static

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import CellCount
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.run_screen import COMMAND_GOES_ON, OVER, cell_text, spark
from brushloop.collect.tui.widgets import SOFTWARE_STOP
from brushloop.sessions.recording import remarks_of
from brushloop.sessions.records import Condition
from tests.collect.tui.fake import ERROR, FAILED, FakeEngine, full_picture, picture
from tests.collect.tui.screen_text import has_picture, look, shown


async def test_what_comes_from_outside_is_shown_as_it_is() -> None:
    markup = "[red]x[/red] [/] [link='"
    engine = FakeEngine(picture(messages=(markup, "a\x1b[31mb"), step=markup, source=markup, error=markup))
    app = OperatorApp(engine)
    async with app.run_test(size=(109, 40)) as pilot:
        await app.screen.mount(Static("a\x1b]0;owned\x07b \x9b31m \u202eltr", markup=False, id="hostile"))
        text = await look(app, pilot)
        assert text.count(markup) == 4
        assert r"a\u001b[31mb" in text
        assert "a]0;ownedb 31m ltr" in text
        assert not set(text) & set("\x1b\x07\x9b\u202e")


async def test_80_columns_by_24_rows_show_all_that_matters() -> None:
    app = OperatorApp(FakeEngine(FAILED))
    async with app.run_test(size=(80, 24)) as pilot:
        text = await look(app, pilot)
    for part in ("2026-11-21-grid-01", "source: loopback rig", "FAILED", "13/30", "elapsed 3:05", "voids 1", "20 mm"):
        assert part in text
    for part in ("123.40", "10°", OVER, COMMAND_GOES_ON, "q Leave"):
        assert part in text
    words = " ".join(text.replace("┃", " ").split())
    assert " ".join(ERROR.split()) in words


async def test_a_run_resized_in_its_middle_shows_the_same() -> None:
    app = OperatorApp(FakeEngine(full_picture()))
    async with app.run_test(size=(200, 60)) as pilot:
        for size in ((200, 60), (80, 24), (120, 40), (81, 25)):
            await pilot.resize_terminal(*size)
            text = await look(app, pilot)
            for part in ("RUNNING", "13/30", "q Leave", "s STOP", "Sheet 1: 25 free", SOFTWARE_STOP):
                assert part in text, size
            assert ("Last capture" in text) == (size[0] >= 110)


async def test_tab_turns_to_the_capture_and_the_camera_where_there_is_no_room_for_all() -> None:
    app = OperatorApp(FakeEngine(full_picture()))
    async with app.run_test(size=(80, 24)) as pilot:
        assert "Log" in await look(app, pilot)
        await pilot.press("tab")
        text = await look(app, pilot)
        for part in ("H15-a5-r01", "✓ all 4 checks", "CCD-BSM as published, right: CSIM"):
            assert part in text
        assert has_picture(text)
        await pilot.press("tab")
        assert "Camera" in await look(app, pilot)
        await pilot.press("tab")
        assert "Log" in await look(app, pilot)


async def test_what_did_not_change_is_not_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    app = OperatorApp(FakeEngine(full_picture()))
    async with app.run_test(size=(120, 40)) as pilot:
        for _ in range(3):
            await look(app, pilot)
        drawn: list[Widget] = []
        refresh = Widget.refresh

        def noted(self: Widget, *regions: Region, **options: Any) -> Widget:
            drawn.append(self)
            return refresh(self, *regions, **options)

        monkeypatch.setattr(Widget, "refresh", noted)
        for _ in range(3):
            await look(app, pilot)
        assert drawn == []


CELL = CellCount(Condition(11.0, 0.0), 1, 2)


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (None, "-"),
        (CELL, "1/2 "),
        (replace(CELL, done=2), "2/2 ✓"),
        (replace(CELL, now=True, bad=1), "1/2 ▶"),
        (replace(CELL, next=True, bad=1), "1/2 ›"),
        (replace(CELL, done=2, bad=1), "2/2 !"),
        (replace(CELL, left_out=1, bad=3), "1/2 ×"),
    ],
)
def test_every_state_of_a_condition_has_a_sign_as_well_as_a_colour(cell: CellCount | None, text: str) -> None:
    assert cell_text(cell).plain == text


def test_a_force_is_drawn_to_scale_and_noise_does_not_fill_its_place() -> None:
    assert spark([0.0, 0.5, 1.0]) == " ▄█"
    assert spark([0.001, 0.0]) == "▁ "


async def test_b_marks_the_last_capture_and_takes_it_back_while_the_run_is_on(tmp_path: Path) -> None:
    engine = FakeEngine(full_picture(folder=str(tmp_path)))
    last = engine.now.last
    assert last is not None
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        engine.now = replace(engine.now, last=replace(last, kept=False))
        await look(app, pilot)
        await pilot.press("b")
        assert remarks_of(tmp_path) == {}, "it does not count anyway"
        engine.now = replace(engine.now, last=last)
        await look(app, pilot)
        await pilot.press("b")
        remark = remarks_of(tmp_path)[last.still]
        assert (remark.stroke_id, remark.bad) == (last.press.stroke_id, True)
        await pilot.press("b")
        assert not remarks_of(tmp_path)[last.still].bad
        engine.now = replace(engine.now, state=State.DONE)
        await look(app, pilot)
        await pilot.press("b")
        assert not remarks_of(tmp_path)[last.still].bad


async def test_a_disk_that_refuses_is_reported(tmp_path: Path) -> None:
    app = OperatorApp(FakeEngine(full_picture(folder=str(tmp_path / "gone"))))
    async with app.run_test(size=(120, 40)) as pilot:
        await pilot.press("b")
        assert "gone" in " ".join(note.message for note in app._notifications)
        assert shown(app)
