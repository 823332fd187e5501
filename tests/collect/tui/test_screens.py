"""The screens around and during a run: what they show as literal text, and what their keys do."""

from __future__ import annotations

import io
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from textual.geometry import Region
from textual.widget import Widget
from textual.widgets import Static

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import Picture
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.pictures import CellPicture, look_for_pixels, picture_widget
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.sessions.recording import remarks_of
from tests.collect.tui.fake import FakeBrowser, FakeEngine, a_review, app_of, full_picture, picture, settled, watched


async def test_what_comes_from_outside_is_shown_as_it_is() -> None:
    markup = "[red]x[/red] [/] [link='"
    now = picture(messages=(markup, "a\x1b[31mb"), step=markup, source=markup, error=markup)
    async with watched(now, (109, 40)) as run:
        await run.app.screen.mount(Static("a\x1b]0;owned\x07b \x9b31m \u202eltr", markup=False, id="hostile"))
        text = await run.look()
        assert text.count(markup) == 4
        assert r"a\u001b[31mb" in text
        assert "a]0;ownedb 31m ltr" in text
        assert not set(text) & set("\x1b\x07\x9b\u202e")


async def test_what_did_not_change_is_not_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    async with watched(full_picture(), (120, 40)) as run:
        for _ in range(2):
            await run.look()
        drawn: list[Widget] = []
        refresh = Widget.refresh

        def noted(self: Widget, *regions: Region, **options: Any) -> Widget:
            drawn.append(self)
            return refresh(self, *regions, **options)

        monkeypatch.setattr(Widget, "refresh", noted)
        for _ in range(3):
            await run.look()
        assert drawn == []


async def test_b_marks_the_last_capture_and_takes_it_back_while_the_run_is_on(tmp_path: Path) -> None:
    now = full_picture(folder=str(tmp_path))
    last = now.last
    assert last is not None
    async with watched(replace(now, last=replace(last, kept=False)), (120, 40)) as run:
        await run.press("b")
        assert remarks_of(tmp_path) == {}, "it does not count anyway"
        await run.look(now)
        await run.press("b")
        remark = remarks_of(tmp_path)[last.still]
        assert (remark.stroke_id, remark.bad) == (last.press.stroke_id, True)
        await run.press("b")
        assert not remarks_of(tmp_path)[last.still].bad
        await run.look(replace(now, folder=str(tmp_path / "gone")))
        await run.press("b")
        assert "/gone" in await run.look(), "a disk that refuses is reported"
        await run.look(replace(now, state=State.DONE))
        await run.press("b")
        assert not remarks_of(tmp_path)[last.still].bad


PROMPT = Prompt(
    "Sheet 1 is full. Put a fresh one in, then go on.",
    (Choice("g", "sheet 2 is in, and blank"), Choice("x", "stop the run")),
    "x",
    number=7,
)


async def test_a_key_answers_the_question_that_is_shown_and_the_next_one_comes() -> None:
    asking = picture(state=State.ASKING, step="wait for an answer", prompt=PROMPT)
    async with watched(asking) as run:
        assert "Waits until it is answered" in await run.look()
        await run.press("z", "escape", "g")
        assert [call for call in run.engine.calls if call.startswith("answer")] == ["answer 7 g"]
        asking = replace(asking, prompt=replace(PROMPT, question="Is there ink?", number=8))
        assert "Is there ink?" in await run.look(asking)
        assert "RUNNING" in await run.look(picture())
        assert isinstance(run.app.screen, RunScreen)


async def test_enter_goes_on_with_an_open_session_and_n_asks_for_a_blank_sheet_first() -> None:
    browser = FakeBrowser()
    app = app_of(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        text = await settled(pilot)
        for part in ("▶ 2026-11-21-grid-02 open", "13 of 30 planned", "13 capture", "the process", "H15-a5-r01"):
            assert part in text
        await pilot.press("n")
        assert "30 strokes on 1 sheet" in await settled(pilot)
        await pilot.press("n")
        assert browser.asked == []
        await pilot.press("n")
        await settled(pilot)
        await pilot.press("y")
        text = await settled(pilot)
        assert browser.asked == [None]
        assert "rig.toml: robot: another brushloop is driving the arm" in text
        await pilot.press("enter")
        await settled(pilot)
        assert browser.asked[1:] == ["2026-11-21-grid-02"]
        assert isinstance(app.engine, FakeEngine)
        assert app.engine.calls == ["start"]
        await pilot.press("s")
        assert "stop" in app.engine.calls


async def test_other_files_can_be_typed_and_letters_of_stop_keys_too() -> None:
    browser = FakeBrowser()
    app = app_of(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        await settled(pilot)
        await pilot.press("e", *"s2.toml", "enter", "backspace", "enter")
        text = await settled(pilot)
        assert "rig s2.toml   protocol protocol.toml" in text, "an emptied field leaves the file as it was"
        await pilot.press("e", *"x", "escape")
        assert "2  examples/protocol-list.toml" in await settled(pilot)
        await pilot.press("2", "enter")
        assert "rig s2.toml   protocol examples/protocol-list.toml" in await settled(pilot)


async def test_no_note_is_typed_while_a_run_is_in_progress(tmp_path: Path) -> None:
    async with watched(picture(state=State.PAUSED), (120, 40)) as run:
        run.app.push_screen(review := a_review(tmp_path, run.app))
        text = await settled(run.pilot)
        for words in ("red button", "s STOP"):
            assert words in text
        assert "o Note" not in text
        await run.press("o", "s")
        assert run.engine.calls == ["stop"]
        assert run.app.screen is review


async def test_a_session_is_analysed_and_the_rig_asked_in_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[list[str]] = []

    def run(command: list[str], *, check: bool) -> subprocess.CompletedProcess[str]:
        ran.append(command[3:])
        return subprocess.CompletedProcess(command, 0)

    app = app_of(browser=FakeBrowser())
    monkeypatch.setattr(app, "suspend", nullcontext)
    monkeypatch.setattr("subprocess.run", run)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    async with app.run_test(size=(120, 40)) as pilot:
        await settled(pilot)
        await pilot.press("down", "a", "d")
    assert ran == [["analyse", "sessions/2026-11-21-grid-01"], ["doctor", "--config", "rig.toml"]]


def test_pictures_work_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "textual_image", None)
    look_for_pixels()
    assert isinstance(picture_widget("x"), CellPicture)


async def test_a_run_without_a_pose_or_a_picture_is_not_green() -> None:
    black, silent = Picture(np.zeros((4, 4), np.uint8)), {"tip_mm": None, "no_pose_s": 1.44}
    async with watched(picture()) as run:
        state = run.app.screen.query_one("#state")
        green = state.styles.background
        for now, word in ((picture(picture=black), "camera is black"), (picture(**silent), "no pose for 1.4 s")):
            text = await run.look(now)
            assert str(state.render()) == f"RUNNING\n{word}"
            assert state.styles.background != green
        assert "Tip      no pose for 1.4 s" in text
        await run.look(picture())
        assert (str(state.render()), state.styles.background) == ("RUNNING", green)


async def test_without_a_protocol_file_that_of_the_newest_session_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kept = Path("sessions/2026-11-21-grid-02/protocol.effective.json")
    kept.parent.mkdir(parents=True)
    kept.touch()
    async with app_of(browser=FakeBrowser()).run_test(size=(120, 40)) as pilot:
        assert f"protocol {kept}" in await settled(pilot)
