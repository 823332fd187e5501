"""What the run screen shows: literal text, sizes, the grid, colours, marks; and how often it is drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from textual.geometry import Region
from textual.widget import Widget
from textual.widgets import Static

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import CellCount, Snapshot
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.panes import BAD, COMPLETE, LEFT_OUT, NEXT, NOW, grid_content
from brushloop.collect.tui.run_screen import COMMAND_GOES_ON, OVER
from brushloop.collect.tui.terminal import DARK, theme_file
from brushloop.collect.tui.text import SOFTWARE_STOP
from brushloop.sessions.recording import remarks_of
from brushloop.sessions.records import Condition
from tests.collect.tui.fake import (
    DONE,
    ERROR,
    FAILED,
    FakeEngine,
    full_picture,
    grid_of,
    marked_grid,
    picture,
)
from tests.collect.tui.screen_text import has_picture, look, shown


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


def test_tilts_go_down_where_the_width_allows() -> None:
    lines = grid_content(grid_of(5), 78).plain.splitlines()
    assert lines[0].split("  ") == ["α \\ H", "11 mm", "13 mm", "15 mm", "17 mm", "20 mm"]
    assert [line.split()[0] for line in lines[1:]] == ["0°", "5°", "10°"]
    assert lines[1].split()[1:3] == ["2/2", "✓"]
    assert len({len(line) for line in lines}) == 1


def test_every_state_has_a_sign_as_well_as_a_colour() -> None:
    text = grid_content(marked_grid(), 78).plain
    for sign in (COMPLETE, NOW, NEXT, BAD, LEFT_OUT):
        assert text.count(sign) == (text.count("2/2") - 1 if sign is COMPLETE else 1), sign


def test_a_cell_that_is_not_planned_is_a_dash() -> None:
    cells = (CellCount(Condition(11.0, 0.0), 0, 2), CellCount(Condition(13.0, 5.0), 2, 2))
    lines = grid_content(cells, 78).plain.splitlines()
    assert lines[1].split() == ["0°", "0/2", "-"]
    assert lines[2].split() == ["5°", "-", "2/2", "✓"]


async def test_a_choice_of_colours_is_there_at_the_next_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    app = OperatorApp(FakeEngine(picture()), theme_file=theme_file())
    async with app.run_test() as pilot:
        assert (app.theme, theme_file().exists()) == (DARK, False)
        [choose] = [command.callback for command in app.get_system_commands(app.screen) if command.title == "Colours"]
        choose()
        await pilot.pause()
        await pilot.press(*"solarized-light", "enter")
        await pilot.pause()
    assert OperatorApp(FakeEngine(picture()), theme_file=theme_file()).theme == "solarized-light"


def at(folder: Path, **changes: object) -> Snapshot:
    return replace(full_picture(), folder=str(folder), **changes)  # type: ignore[arg-type]


async def test_b_marks_the_last_capture_and_takes_it_back(tmp_path: Path) -> None:
    engine = FakeEngine(at(tmp_path))
    last = engine.now.last
    assert last is not None
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        await pilot.press("b")
        remark = remarks_of(tmp_path)[last.still]
        assert (remark.stroke_id, remark.bad) == (last.press.stroke_id, True)
        await pilot.press("b")
        assert not remarks_of(tmp_path)[last.still].bad


async def test_b_says_nothing_of_a_capture_that_does_not_count_nor_once_the_run_is_over(tmp_path: Path) -> None:
    now = at(tmp_path)
    assert now.last is not None
    for silent in (
        replace(now, last=replace(now.last, kept=False)),
        replace(now, last=None),
        at(tmp_path, state=State.DONE),
    ):
        app = OperatorApp(FakeEngine(silent))
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("b")
        assert remarks_of(tmp_path) == {}


async def test_a_disk_that_refuses_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    app = OperatorApp(FakeEngine(at(tmp_path / "gone")))
    notices: list[str] = []
    monkeypatch.setattr(app, "notify", lambda message, **_options: notices.append(message))
    async with app.run_test(size=(120, 40)) as pilot:
        await pilot.press("b")
    [notice] = notices
    assert "gone" in notice
