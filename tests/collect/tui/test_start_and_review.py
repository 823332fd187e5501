"""The screens around a run: start, review, what comes next, pictures."""

from __future__ import annotations

import io
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from textual.geometry import Size
from textual.pilot import Pilot

from brushloop.collect.errors import ConfigError
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.pictures import CellPicture, braille, look_for_pixels, picture_widget, strip_of
from brushloop.collect.tui.start_screen import StartScreen
from brushloop.collect.tui.widgets import AskScreen
from brushloop.sessions.recording import remarks_of
from tests.collect.tui.fake import PAUSED, FakeBrowser, FakeEngine, a_review, has_picture, look, picture, shown


class Beginning(FakeBrowser):
    """Notes which session is gone on with."""

    def engine(self, session_id: str | None) -> Any:
        self.asked.append(session_id)
        if session_id is None:
            raise ConfigError("rig.toml", "robot", "another brushloop is driving the arm")
        return FakeEngine(picture())


async def ready(app: OperatorApp, pilot: Pilot[None]) -> str:
    await pilot.pause()
    await app.workers.wait_for_complete()
    await pilot.pause()
    return shown(app)


async def test_enter_goes_on_with_an_open_session_and_n_asks_for_a_blank_sheet_first() -> None:
    browser = Beginning()
    app = OperatorApp(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        text = await ready(app, pilot)
        for part in ("▶ 2026-11-21-grid-02 open", "13 of 30 planned", "13 capture", "the process", "H15-a5-r01"):
            assert part in text
        await pilot.press("n")
        assert "30 strokes on 1 sheet" in await ready(app, pilot)
        await pilot.press("n")
        assert browser.asked == []
        await pilot.press("n")
        await ready(app, pilot)
        await pilot.press("y")
        text = await ready(app, pilot)
        assert browser.asked == [None]
        assert "rig.toml: robot: another brushloop is driving the arm" in text
        await pilot.press("enter")
        await ready(app, pilot)
        assert browser.asked[1:] == ["2026-11-21-grid-02"]
        assert isinstance(app.engine, FakeEngine)
        assert app.engine.calls == ["start"]
        await look(app, pilot)
        await pilot.press("s")
        assert "stop" in app.engine.calls


async def test_other_files_can_be_typed_and_letters_of_stop_keys_too() -> None:
    browser = FakeBrowser()
    app = OperatorApp(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        await ready(app, pilot)
        await pilot.press("e", "ctrl+u", *"s2.toml", "enter", "ctrl+u", "enter")
        text = await ready(app, pilot)
        assert "rig s2.toml   protocol protocol.toml" in text, "an emptied field leaves the file as it was"
        await pilot.press("e", *"x", "escape", *"s", "enter")
        assert "rig s2.toml   protocol protocol.tomls" in await ready(app, pilot)


async def test_marks_and_notes_are_kept_beside_the_recording(tmp_path: Path) -> None:
    app = OperatorApp(browser=FakeBrowser())
    async with app.run_test(size=(120, 40)) as pilot:
        await ready(app, pilot)
        app.push_screen(a_review(tmp_path, app))
        text = await ready(app, pilot)
        for part in (
            "1 of 3 count",
            "mean CSIM 0.914 of every pair of 9 presses",
            "still 4",
            "Waited    1.2 s from dip to touch",
            "H13-a0-r03 dip?",
        ):
            assert part in text
        assert has_picture(text)
        await pilot.press("b")
        await ready(app, pilot)
        await pilot.press("o", *"so so", "enter")
        await ready(app, pilot)
        remark = remarks_of(tmp_path / "2026-11-21-grid-01")[4]
        assert (remark.stroke_id, remark.note) == ("H13-a0-r01", "so so")
        await pilot.press("down")
        text = await ready(app, pilot)
        assert "marked bad" in text
        assert "墨 ran" in text
        await pilot.press("escape")
        assert isinstance(app.screen, StartScreen)


async def test_no_note_is_typed_while_a_run_is_in_progress(tmp_path: Path) -> None:
    engine = FakeEngine(PAUSED)
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        await look(app, pilot)
        app.push_screen(review := a_review(tmp_path, app))
        text = await ready(app, pilot)
        for words in ("red button", "s STOP"):
            assert words in text
        assert "o Note" not in text
        await pilot.press("o", "f", "s")
        assert engine.calls == ["stop"]
        assert app.screen is review


async def test_after_a_session_the_next_commands_run_in_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[list[str]] = []

    def run(command: list[str], *, check: bool) -> subprocess.CompletedProcess[str]:
        ran.append(command[3:])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.chdir(tmp_path)
    app = OperatorApp(browser=FakeBrowser())
    monkeypatch.setattr(app, "suspend", nullcontext)
    monkeypatch.setattr("subprocess.run", run)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    async with app.run_test(size=(120, 40)) as pilot:
        await ready(app, pilot)
        app.push_screen(a_review(Path(), app))
        await ready(app, pilot)
        await pilot.press("f")
        assert "c  brushloop calibrate" in await ready(app, pilot)
        for key in ("f", "c", "t", "w"):
            await pilot.press(key)
            await ready(app, pilot)
            assert isinstance(app.screen, AskScreen), "back at the question"
        await pilot.press("escape", "escape", "d")
    folder = "2026-11-21-grid-01"
    assert ran == [
        ["sessions", "verify", folder],
        ["calibrate", folder],
        ["fit", folder],
        ["validate", folder],
        ["doctor", "--config", "rig.toml"],
    ]


def test_pictures_work_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "textual_image", None)
    look_for_pixels()
    assert isinstance(picture_widget("x"), CellPicture)


def test_a_pixel_is_a_dot_of_its_own_colour_on_the_colour_of_most() -> None:
    paper = np.full((4, 4), 255, np.uint8)
    paper[0, 0] = paper[3, 3] = 0
    [line] = braille(paper, Size(2, 1))
    assert strip_of(line).text == "⠁⢀"
    colours = np.full((4, 4, 3), 255, np.uint8)
    colours[:, 2:] = (0, 114, 181)
    colours[0, 3] = 255
    [line] = braille(colours, Size(2, 1))
    strip = strip_of(line)
    assert strip.text == "⠀⠈"
    assert str(list(strip)[1].style) == "rgb(255,255,255) on rgb(0,115,180)"
