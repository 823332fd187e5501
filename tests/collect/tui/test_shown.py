"""What the run screen shows: literal text, sizes, and how often it is drawn."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from textual.geometry import Region
from textual.widget import Widget
from textual.widgets import Static

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.run_screen import COMMAND_GOES_ON, OVER
from brushloop.collect.tui.text import SOFTWARE_STOP
from brushloop.collect.tui.widgets import Line
from tests.collect.tui.fake import (
    DONE,
    ERROR,
    FAILED,
    PAUSED,
    FakeEngine,
    full_picture,
    grid_of,
    picture,
)
from tests.collect.tui.screen_text import has_picture, look, shown

AT_WORK = sorted(set(State) - FINAL)


async def test_what_comes_from_outside_is_shown_as_it_is() -> None:
    markup = "[red]x[/red] [/] [link='"
    engine = FakeEngine(picture(messages=(markup, "a\x1b[31mb"), step=markup, source=markup, error=markup))
    app = OperatorApp(engine)
    async with app.run_test(size=(109, 40)) as pilot:
        text = await look(app, pilot)
        assert text.count(markup) == 4
        assert r"a\u001b[31mb" in text
        assert "\x1b" not in text


async def test_no_widget_can_hand_a_control_character_to_the_terminal() -> None:
    app = OperatorApp(FakeEngine(picture()))
    async with app.run_test(size=(80, 24)) as pilot:
        await app.screen.mount(Static("a\x1b]0;owned\x07b \x9b31m \u202eltr", markup=False, id="hostile"))
        await pilot.pause()
        text = shown(app)
        assert "a]0;ownedb 31m ltr" in text
        assert not set(text) & set("\x1b\x07\x9b\u202e")


async def test_chinese_takes_its_two_columns() -> None:
    engine = FakeEngine(picture(session_id="永字八法", messages=("墨分五色 capture 1",), step="写 永"))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        await look(app, pilot)
        for place in ("session", "figures", "log"):
            widget = app.screen.query_one(f"#{place}")
            strips = widget.render_lines(Region(0, 0, *widget.size))
            assert {strip.cell_length for strip in strips} == {widget.size.width}
        assert "永字八法" in shown(app)


async def test_grid_counts_follow_the_snapshot() -> None:
    engine = FakeEngine(picture(grid=grid_of(1)))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        before = await look(app, pilot)
        assert before.count("1/2") == 1
        assert before.count("✓") == 0
        engine.now = picture(grid=grid_of(3))
        after = await look(app, pilot)
        assert after.count("2/2 ✓") == 1
        assert after.count("1/2") == 1


async def test_80_columns_by_24_rows_show_all_that_matters() -> None:
    app = OperatorApp(FakeEngine(FAILED))
    async with app.run_test(size=(80, 24)) as pilot:
        text = await look(app, pilot)
    for part in ("2026-11-21-grid-01", "source: loopback rig", "FAILED", "13/30", "elapsed 3:05", "voids 1", "20 mm"):
        assert part in text
    for part in ("123.40", "10°", OVER, COMMAND_GOES_ON, "q leave"):
        assert part in text
    words = " ".join(text.replace("┃", " ").split())
    assert " ".join(ERROR.split()) in words


async def test_a_run_resized_in_its_middle_shows_the_same() -> None:
    app = OperatorApp(FakeEngine(full_picture()))
    async with app.run_test(size=(200, 60)) as pilot:
        for size in ((200, 60), (80, 24), (120, 40), (81, 25)):
            await pilot.resize_terminal(*size)
            text = await look(app, pilot)
            for part in ("RUNNING", "13/30", "q leave", "s STOP", "Sheet 1: 25 free", SOFTWARE_STOP):
                assert part in text, size
            assert ("Capture, " in text) == (size[0] >= 110)


async def test_tab_turns_to_the_capture_and_the_camera_where_there_is_no_room_for_all() -> None:
    app = OperatorApp(FakeEngine(full_picture()))
    async with app.run_test(size=(80, 24)) as pilot:
        assert "Log" in await look(app, pilot)
        await pilot.press("tab")
        text = await look(app, pilot)
        assert "H15-a5-r01" in text
        assert "CCD-BSM as published for this H and α, right: CSIM" in text
        assert has_picture(text)
        await pilot.press("tab")
        assert "Camera" in await look(app, pilot)
        await pilot.press("tab")
        assert "Log" in await look(app, pilot)


async def test_missing_pose_and_eta_are_said() -> None:
    app = OperatorApp(
        FakeEngine(picture(tip_mm=None, eta_s=None, session_id="", source="", grid=(), strokes_planned=0))
    )
    async with app.run_test() as pilot:
        text = await look(app, pilot)
    for part in ("no pose", "no ETA yet", "no session yet", "not known yet", "no strokes planned", "no sheet yet"):
        assert part in text


async def test_the_log_follows_until_scrolled_away() -> None:
    engine = FakeEngine(picture(messages=tuple(f"line {n}" for n in range(100))))
    app = OperatorApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        assert "line 99" in await look(app, pilot)
        engine.now = picture(messages=tuple(f"line {n}" for n in range(50, 150)))
        assert "line 149" in await look(app, pilot)
        await pilot.press("home")
        assert "line 50" in await look(app, pilot)
        engine.now = picture(messages=tuple(f"line {n}" for n in range(50, 151)))
        assert "line 50" in await look(app, pilot)
        await pilot.press("end")
        assert "line 150" in await look(app, pilot)


async def test_the_engine_is_asked_ten_times_a_second_and_nothing_is_drawn_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine = FakeEngine(PAUSED)
    app = OperatorApp(engine)
    async with app.run_test() as pilot:
        await look(app, pilot)
        drawn: list[Line] = []
        monkeypatch.setattr(Line, "update", lambda line, *_args, **_options: drawn.append(line))
        looks = engine.looks
        await asyncio.sleep(1.0)
        assert 5 <= engine.looks - looks <= 12
        assert drawn == []


async def test_an_error_of_the_engine_is_a_crash_not_a_blank() -> None:
    class Broken(FakeEngine):
        def snapshot(self):
            if self.looks > 2:
                raise ZeroDivisionError
            return super().snapshot()

    with pytest.raises(ZeroDivisionError):
        async with OperatorApp(Broken(DONE)).run_test() as pilot:
            await pilot.pause(0.5)


async def test_what_did_not_change_is_not_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = FakeEngine(full_picture())
    app = OperatorApp(engine, now_s=lambda: 1010.0)
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
