"""The operator's screens: what they show, as literal text, and what their keys do; and no arm is left unwatched:
signals, lost terminals, defects of the screen."""

from __future__ import annotations

import functools
import io
import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import numpy as np
import pytest
from textual.geometry import Region
from textual.pilot import Pilot
from textual.widget import Widget
from textual.widgets import Static

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.snapshot import Picture, Snapshot
from brushloop.collect.errors import CollectAborted, ConfigError
from brushloop.collect.tui import run_screen, terminal
from brushloop.collect.tui.app import OperatorApp, ScreenCrashed, run_app
from brushloop.collect.tui.pictures import CellPicture, look_for_pixels, picture_widget
from brushloop.collect.tui.run_screen import COMMAND_GOES_ON, GOES_ON, OVER, RunScreen
from brushloop.collect.tui.terminal import TerminalDriver, _LostWrites
from brushloop.collect.tui.widgets import SOFTWARE_STOP, AskScreen
from brushloop.sessions.recording import remarks_of
from tests.collect.tui.fake import (
    FAILED,
    SPLIT,
    FakeBrowser,
    FakeEngine,
    Watched,
    app_of,
    full_picture,
    picture,
    settled,
    watched,
)
from tests.waiting import until

KEYS = ("space", "r", "k", "n", "j", "b")
SPACE = {
    **dict.fromkeys((State.IDLE, State.RECOVERING, State.RUNNING), "pause"),
    **dict.fromkeys((State.PAUSING, State.PAUSED), "resume"),
}
"""What the space bar asks of the engine; nothing in the other states."""


def asks(app: OperatorApp) -> bool:
    return isinstance(app.screen, AskScreen) and app.screen.own


async def test_in_every_state_of_a_run_stop_keys_stop_and_space_pauses_or_resumes_where_it_says_so() -> None:
    async with watched(picture()) as run:
        for state in sorted(set(State) - FINAL):
            text = await run.look(picture(state=state))
            run.engine.calls.clear()
            await run.press("space", "s", "ctrl+c")
            asked = [SPACE[state]] if state in SPACE else []
            assert run.engine.calls == [*asked, "stop", "stop"], state
            assert all(f"space {call.title()}" in text for call in asked), text


@pytest.mark.parametrize("over", ["q", "question_mark", "enter", "prompt"])
async def test_the_stop_key_stops_over_whatever_lies_on_the_screen(over: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "STOP_SHOWN_S", 600.0)  # a busy machine looks late
    async with watched(full_picture()) as run:
        if over == "prompt":
            await run.look(picture(state=State.ASKING, prompt=SPLIT))
        else:
            await run.press(over)
        await run.look()
        assert over == "question_mark" or not isinstance(run.app.screen, RunScreen)
        await run.press("s")
        assert run.engine.calls == ["stop"]
        assert "STOP SENT" in await run.look()
        await run.press("escape")
        assert isinstance(run.app.screen, RunScreen) is (over != "prompt")


async def test_requests_are_passed_on_and_shown_until_they_are_carried_out() -> None:
    async with watched(picture()) as run:
        for key, request in (("r", "RETAKE"), ("k", "SKIP"), ("n", "NEW_SHEET"), ("j", "JOG")):
            run.engine.calls.clear()
            assert "asked" not in await run.look(picture())
            await run.press(key)
            assert run.engine.calls == [f"request {request}"]
            text = await run.look()
            assert f"asked: {run.engine.now.requests[0]}" in text
            assert "red button: emergency stop" in text


@pytest.mark.parametrize("now", [picture(), picture(state=State.ASKING, prompt=SPLIT)], ids=["running", "asking"])
async def test_q_asks_while_the_run_is_on_and_parks_before_it_leaves(now: Snapshot) -> None:
    async with watched(now) as run:
        for quit_key, no_key in (("q", "n"), ("ctrl+q", "escape")):
            await run.press(quit_key, quit_key)
            assert asks(run.app)
            await run.press(no_key)
            assert not asks(run.app)
        assert run.engine.calls == []
        await run.press("q", "y")
        assert run.engine.calls == ["park"]
        await until_over(run.pilot)
    assert run.app.return_code == 0


async def test_a_force_is_not_called_zeroed_before_it_is() -> None:
    async with watched(full_picture(force_ceiling_n=None)) as run:
        assert "0.041 N (not zeroed yet)" in await run.look()


async def test_while_the_arm_is_being_stopped_q_asks_nothing_and_the_red_button_is_named() -> None:
    async with watched(picture(state=State.STOPPING)) as run:
        assert "not seen at rest yet: press the red button" in await run.look()
        await run.press("q")
        assert not asks(run.app)
        assert run.engine.calls == []


async def test_an_arm_that_was_not_seen_at_rest_is_never_said_to_rest() -> None:
    unseen = replace(FAILED, rest_unknown=True, parked=False, target_mm=(0.0, 0.0, 0.0))
    async with watched(unseen) as run:
        assert SOFTWARE_STOP in await run.look(), "not how to go on"
        await run.press("q")
        text = await run.look()
        assert "may still be moving" in text
        assert "it rests where" not in text
        await run.press("y")
        assert not run.app.is_running


async def test_a_key_answers_the_newest_question_and_asks_for_nothing_where_it_bounces(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with watched(picture()) as run:
        for number, bounce_s, then in ((4, 0.0, ["request SKIP"]), (5, 1e9, [])):
            monkeypatch.setattr(run_screen, "BOUNCE_S", bounce_s)
            run.engine.calls.clear()
            await run.look(picture(state=State.ASKING, prompt=SPLIT))
            await run.look(picture(state=State.ASKING, prompt=replace(SPLIT, number=number)))
            await run.press("z", "escape", "k")
            await run.look(picture())
            assert isinstance(run.app.screen, RunScreen)
            await run.press("k")
            assert run.engine.calls == [f"answer {number} k", *then]


@pytest.mark.parametrize("state", sorted(FINAL))
async def test_what_is_over_can_only_be_left(state: State) -> None:
    async with watched(picture(state=state, parked=True, target_mm=(0.0, 0.0, 0.0))) as run:
        text = await run.look()
        assert OVER in text
        assert state.upper() in text
        assert (COMMAND_GOES_ON in text) is (state is not State.DONE)
        assert (SOFTWARE_STOP in text) is (state is State.DONE)
        assert "s STOP" not in text
        await run.press(*KEYS)
        assert run.engine.calls == []
        await run.press("q")
        assert not run.app.is_running


@pytest.mark.parametrize("outcome", ["resumes", "a refusal", "a signal"])
async def test_enter_resumes_a_stopped_session_and_leaves_the_question_to_the_engine(outcome: str) -> None:
    stopped: Any = FakeEngine(picture(state=State.STOPPED, folder="sessions/2026-11-21-grid-01"))
    stopped.stop()
    resumed = FakeEngine(picture())
    asked: list[str] = []

    def again(session_id: str) -> Any:
        asked.append(session_id)
        if outcome == "a refusal":
            raise ConfigError("rig.toml", "", "goes on with no open session")
        app.leaving = outcome == "a signal"  # which comes while files are read
        return resumed

    app = OperatorApp(again, stopped)
    async with app.run_test(size=(80, 24)) as pilot:
        text = await Watched(stopped, app, pilot).look()
        assert "Resume the session" in text
        assert GOES_ON in text
        await pilot.press("enter")
        await app.workers.wait_for_complete()
        assert asked == ["2026-11-21-grid-01"]
        assert stopped.calls == ["stop", "join"]
        if outcome == "a refusal":
            assert [note.message for note in app._notifications] == ["rig.toml: goes on with no open session"]
        if outcome == "resumes":
            assert "RUNNING" in await Watched(resumed, app, pilot).look()
    assert resumed.calls == (["start"] if outcome == "resumes" else [])
    assert app.engine is (resumed if outcome == "resumes" else stopped)


# What is shown, and the screens around a run


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


async def test_the_model_is_fitted_every_few_strokes_and_its_newest_scores_are_shown(model_so_far: AsyncMock) -> None:
    now = picture(folder="2026-11-21-grid-01", strokes_done=4)
    async with watched(now, (120, 40)) as run:
        assert "Model by now" not in await run.look()
        model_so_far.return_value = 94.51, "from 5 presses"
        assert "94.5 % from 5 presses" in await run.look(replace(now, strokes_done=5))
        await run.look(replace(now, strokes_done=9))
        model_so_far.return_value = 96.13, "from 10 presses; a perfect model: 98.2 %"
        text = await run.look(replace(now, strokes_done=10))
        assert "94.5 → 96.1 % from 10 presses; a perfect model: 98.2 %" in text
        assert model_so_far.await_count == 2


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


async def test_a_session_is_analysed_and_the_rig_asked_in_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    app = app_of(browser=FakeBrowser())
    monkeypatch.setattr(app, "suspend", nullcontext)
    monkeypatch.setattr("subprocess.run", run := Mock(return_value=subprocess.CompletedProcess([], 0)))
    monkeypatch.setattr("sys.stdin", io.StringIO())
    async with app.run_test(size=(120, 40)) as pilot:
        await settled(pilot)
        await pilot.press("down", "a", "d")
    assert [call.args[0][3:] for call in run.call_args_list] == [
        ["analyse", "sessions/2026-11-21-grid-01"],
        ["doctor", "--config", "rig.toml"],
    ]


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


# However the screen ends, the arm is stopped or parked


def without_terminal(monkeypatch: pytest.MonkeyPatch, pilot: object) -> None:
    monkeypatch.setattr(OperatorApp, "run", functools.partialmethod(OperatorApp.run, headless=True, auto_pilot=pilot))


async def until_over(pilot: Pilot[None]) -> None:
    await until(lambda: not pilot.app.is_running, "the end of the screen")


@pytest.mark.parametrize(
    ("number", "call"), [(signal.SIGTERM, "stop"), (signal.SIGINT, "stop"), (signal.SIGHUP, "park")]
)
def test_a_signal_stops_the_arm_a_lost_terminal_parks_it_and_both_end_the_screen(
    number: int, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def send(pilot: Pilot[None]) -> None:
        os.kill(os.getpid(), number)
        await until_over(pilot)

    without_terminal(monkeypatch, send)
    engine = FakeEngine(picture())
    before = signal.getsignal(number)
    with pytest.raises(CollectAborted):
        run_app(app_of(engine))
    assert engine.calls == ["start", call, "join"]
    assert signal.getsignal(number) == before


def test_a_screen_that_breaks_stops_the_arm(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Broken(FakeEngine):
        def snapshot(self):
            if self.looks > 2:
                raise ZeroDivisionError
            return super().snapshot()

    without_terminal(monkeypatch, until_over)
    engine = Broken(picture())
    with pytest.raises(ScreenCrashed):
        run_app(app_of(engine))
    assert engine.calls == ["start", "stop", "join"]
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_a_lost_terminal_hurts_nobody_and_does_not_start_the_driver_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = OSError(5, "Input/output error")
    file = _LostWrites(Mock(write=Mock(side_effect=gone), flush=Mock(side_effect=gone)))
    assert file.write("abc") == 3
    file.flush()
    started: list[str] = []
    monkeypatch.setattr(TerminalDriver, "start_application_mode", lambda _driver: started.append("start"))
    TerminalDriver.__new__(TerminalDriver).resume_application_mode()
    assert started == []
