"""Keys, polling and literal text of the run screen."""

from __future__ import annotations

import asyncio

import pytest
from textual.pilot import Pilot

from collect.states import FINAL, State
from collect.tui.app import RunApp
from collect.tui.confirm import ConfirmQuit
from collect.tui.view import OVER, SOFTWARE_STOP, Line
from tests.collect.tui.fake import DONE, ERROR, FAILED, PAUSED, FakeEngine, grid_of, picture


def shown(app: RunApp) -> str:
    """What is on the screen, as text."""
    strips = app.screen_stack[0]._compositor.render_strips()
    return "\n".join("".join(segment.text for segment in strip) for strip in strips)


async def look(app: RunApp, pilot: Pilot[None]) -> str:
    """The screen after two polls: the first may come before the layout has its sizes."""
    engine = app._engine
    assert isinstance(engine, FakeEngine)
    enough = engine.looks + 2
    while engine.looks < enough:
        await pilot.pause(0.02)
    await pilot.pause()
    return shown(app)


async def test_p_pauses_and_resumes_and_says_which() -> None:
    engine = FakeEngine(picture())
    app = RunApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        assert "p Pause" in await look(app, pilot)
        await pilot.press("p")
        assert engine.calls == ["pause"]
        for state in (State.PAUSING, State.PAUSED):
            engine.calls.clear()
            engine.now = picture(state=state)
            text = await look(app, pilot)
            assert "p Resume" in text
            assert "Pause" not in text
            await pilot.press("p")
            assert engine.calls == ["resume"]


@pytest.mark.parametrize("state", sorted({State.STOPPING} | FINAL))
async def test_p_does_nothing_once_the_end_has_begun(state: State) -> None:
    engine = FakeEngine(picture(state=state))
    app = RunApp(engine)
    async with app.run_test() as pilot:
        text = await look(app, pilot)
        await pilot.press("p")
        assert engine.calls == []
        assert "p Pause" not in text
        assert "p Resume" not in text


@pytest.mark.parametrize("key", ["s", "ctrl+c"])
@pytest.mark.parametrize("state", list(State))
async def test_stop_keys_stop_in_every_state(state: State, key: str) -> None:
    engine = FakeEngine(picture(state=state))
    app = RunApp(engine)
    async with app.run_test() as pilot:
        await pilot.press(key)
        assert engine.calls == ["stop"]


async def test_no_focus_keeps_a_key_for_itself() -> None:
    engine = FakeEngine(FAILED)
    app = RunApp(engine)
    async with app.run_test() as pilot:
        for focus in ("why-pane", "grid-pane", "log-pane"):
            engine.calls.clear()
            app.query_one(f"#{focus}").focus()
            await pilot.press("s", "ctrl+c")
            assert engine.calls == ["stop", "stop"]
        await pilot.press("q")
        assert not app.is_running


@pytest.mark.parametrize("key", ["s", "ctrl+c"])
async def test_stop_keys_work_under_the_question(key: str) -> None:
    engine = FakeEngine(picture())
    app = RunApp(engine)
    async with app.run_test() as pilot:
        await pilot.press("q")
        assert isinstance(app.screen, ConfirmQuit)
        await pilot.press(key)
        assert engine.calls == ["stop"]


@pytest.mark.parametrize("quit_key", ["q", "ctrl+q"])
@pytest.mark.parametrize("no_key", ["n", "escape"])
async def test_q_asks_while_the_run_is_on_and_n_goes_back(quit_key: str, no_key: str) -> None:
    engine = FakeEngine(picture())
    app = RunApp(engine)
    async with app.run_test() as pilot:
        await pilot.press(quit_key, quit_key)
        assert isinstance(app.screen, ConfirmQuit)
        await pilot.press(no_key)
        assert not isinstance(app.screen, ConfirmQuit)
        assert engine.calls == []
        assert app.is_running


async def test_the_run_is_watched_on_under_the_question() -> None:
    engine = FakeEngine(picture())
    app = RunApp(engine)
    async with app.run_test() as pilot:
        await pilot.press("q")
        engine.now = FAILED
        assert "FAILED" in await look(app, pilot)
        assert isinstance(app.screen, ConfirmQuit)


async def test_y_stops_the_arm_and_leaves() -> None:
    engine = FakeEngine(picture())
    app = RunApp(engine)
    async with app.run_test() as pilot:
        await pilot.press("q", "y")
        assert engine.calls == ["stop"]
        assert not app.is_running
    assert app.return_code == 0


@pytest.mark.parametrize("state", sorted(FINAL))
async def test_q_leaves_at_once_when_the_run_is_over(state: State) -> None:
    engine = FakeEngine(picture(state=state))
    app = RunApp(engine)
    async with app.run_test() as pilot:
        text = await look(app, pilot)
        assert OVER in text
        assert state.upper() in text
        await pilot.press("q")
        assert not app.is_running
    assert engine.calls == []


async def test_what_comes_from_outside_is_shown_as_it_is() -> None:
    markup = "[red]x[/red] [/] [link='"
    engine = FakeEngine(picture(messages=(markup, "a\x1b[31mb"), step=markup, source=markup, error=markup))
    app = RunApp(engine)
    async with app.run_test(size=(100, 40)) as pilot:
        text = await look(app, pilot)
        assert text.count(markup) == 4
        assert "a�[31mb" in text
        assert "\x1b" not in text


async def test_grid_counts_follow_the_snapshot() -> None:
    engine = FakeEngine(picture(grid=grid_of(1)))
    app = RunApp(engine)
    async with app.run_test(size=(80, 24)) as pilot:
        before = await look(app, pilot)
        assert before.count("1/2") == 1
        assert before.count("✓") == 1  # the legend
        engine.now = picture(grid=grid_of(3))
        after = await look(app, pilot)
        assert after.count("2/2 ✓") == 1
        assert after.count("1/2") == 1


async def test_80_columns_by_24_rows_show_all_that_matters() -> None:
    app = RunApp(FakeEngine(FAILED))
    async with app.run_test(size=(80, 24)) as pilot:
        text = await look(app, pilot)
    for part in (
        "2026-11-21-grid-01",
        "source: loopback rig",
        "FAILED",
        "13/30",
        "elapsed 3:05",
        "Voids    1",
        "20 mm",
    ):
        assert part in text
    for part in ("Voids    1", "123.40", "10°", OVER, SOFTWARE_STOP, "Stop arm", "q Quit"):
        assert part in text
    words = " ".join(text.replace("┃", " ").split())
    assert " ".join(ERROR.split()) in words


async def test_missing_pose_and_eta_are_said() -> None:
    app = RunApp(FakeEngine(picture(tip_mm=None, eta_s=None, session_id="", source="", grid=(), strokes_planned=0)))
    async with app.run_test() as pilot:
        text = await look(app, pilot)
    for part in ("no pose", "no ETA yet", "no session yet", "not known yet", "no strokes planned"):
        assert part in text


async def test_the_log_follows_until_scrolled_away() -> None:
    engine = FakeEngine(picture(messages=tuple(f"line {n}" for n in range(100))))
    app = RunApp(engine)
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
    app = RunApp(engine)
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
        async with RunApp(Broken(DONE)).run_test() as pilot:
            await pilot.pause(0.5)
