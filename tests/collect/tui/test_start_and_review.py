"""The screens around a run: start, review, finish, pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from textual.geometry import Size
from textual.pilot import Pilot

from brushloop.collect.errors import ConfigError
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.dots import Cells
from brushloop.collect.tui.finish_screen import FinishScreen, run_command, verdict_content
from brushloop.collect.tui.pictures import CellPicture, Pictures
from brushloop.collect.tui.question_screens import Confirm
from brushloop.collect.tui.start_screen import StartScreen
from brushloop.collect.tui.text import plot, plot_title, scale_n, spark
from brushloop.sessions.recording import remarks_of
from brushloop.sessions.terminal import Progress
from brushloop.sessions.verify import Verdict
from tests.collect.tui.fake import PAUSED, FakeEngine, picture
from tests.collect.tui.fake_browser import FakeBrowser, a_review
from tests.collect.tui.screen_text import has_picture, look, shown


class Beginning(FakeBrowser):
    """Notes which session is gone on with."""

    def engine(self, session_id: str | None, *, preview: bool) -> Any:
        self.asked.append((session_id, preview))
        if session_id is None:
            raise ConfigError("rig.toml", "robot", "another brushloop is driving the arm")
        return FakeEngine(picture())


async def ready(app: OperatorApp, pilot: Pilot[None]) -> str:
    await pilot.pause()
    await app.workers.wait_for_complete()
    await pilot.pause()
    return shown(app)


async def test_the_start_screen_shows_what_is_finished_void_and_next() -> None:
    app = OperatorApp(browser=FakeBrowser())
    async with app.run_test(size=(80, 24)) as pilot:
        text = await ready(app, pilot)
        for part in ("▶ 2026-11-21-grid-02 open", "13 of 30 strokes", "1 cut short", "the process", "press H15-a5-r01"):
            assert part in text
        await pilot.press("d")
        text = await ready(app, pilot)
        for part in ("✓ well    camera", "! trouble robot", "ProtectiveStop"):
            assert part in text


async def test_enter_goes_on_with_an_open_session_and_n_asks_for_a_blank_sheet_first() -> None:
    browser = Beginning()
    app = OperatorApp(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        await ready(app, pilot)
        await pilot.press("n")
        await ready(app, pilot)
        assert isinstance(app.screen, Confirm)
        await pilot.press("n")
        assert browser.asked == []
        await pilot.press("n")
        await ready(app, pilot)
        await pilot.press("y")
        text = await ready(app, pilot)
        assert browser.asked == [(None, True)]
        assert "rig.toml: robot: another brushloop is driving the arm" in text
        await pilot.press("enter")
        await ready(app, pilot)
        assert browser.asked[1:] == [("2026-11-21-grid-02", True)]
        assert app.engine is not None
        assert app.engine.calls == ["start"]  # type: ignore[attr-defined]
        await look(app, pilot)
        await pilot.press("s")
        assert "stop" in app.engine.calls  # type: ignore[attr-defined]


async def test_other_files_can_be_typed_and_letters_of_stop_keys_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    browser = FakeBrowser()
    app = OperatorApp(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        await ready(app, pilot)
        await pilot.press("e", "ctrl+u", *"s2.toml", "enter")
        await ready(app, pilot)
        assert str(browser.paths.config) == "s2.toml"
        assert isinstance(app.screen, StartScreen)
        await pilot.press("e", "ctrl+u", "enter")
        assert "s2.toml" in await ready(app, pilot), "an emptied field leaves the file as it was"
    assert str(browser.paths.config) == "s2.toml"
    assert FakeBrowser().paths == browser.paths, "the next start knows the files"


async def test_marks_and_notes_are_kept_beside_the_recording(tmp_path: Path) -> None:
    app = OperatorApp(browser=FakeBrowser())
    async with app.run_test(size=(120, 40)) as pilot:
        await ready(app, pilot)
        review = a_review(tmp_path)
        app.push_screen(review)
        text = await ready(app, pilot)
        for part in (
            "1 of 3 count",
            "mean CSIM 0.914 of every pair of 9 presses",
            "still 4  at 1795273966.402 s",
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
        await pilot.press("down")
        assert "! touched the paper 10.2 s after its dip" in await ready(app, pilot)
        await pilot.press("escape")
        assert isinstance(app.screen, StartScreen)


async def test_no_note_is_typed_while_a_run_is_in_progress(tmp_path: Path) -> None:
    engine = FakeEngine(PAUSED)
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        await look(app, pilot)
        review = a_review(tmp_path, lambda: app.at_work)
        app.push_screen(review)
        text = await ready(app, pilot)
        for words in ("A run is in progress", "red button", "s STOP"):
            assert words in text
        assert "o note" not in text
        assert "arm is at work" not in text
        await pilot.press("o", "s")
        assert engine.calls == ["stop"]
        assert not review.has_class("-noting")


async def test_finishing_verifies_and_runs_what_comes_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[tuple[str, Path]] = []

    def command(name: str, folder: Path, progress: Progress) -> tuple[int, str]:
        ran.append((name, folder))
        progress("captures", 3, 30)
        return 0, "\n".join(f"line {n}" for n in range(30))

    monkeypatch.setattr("brushloop.collect.tui.finish_screen.run_command", command)
    monkeypatch.setattr(
        "brushloop.collect.tui.finish_screen.verify", lambda _folder: Verdict("s", "closed", files=3, strokes=2)
    )
    app = OperatorApp(browser=FakeBrowser())
    async with app.run_test(size=(120, 40)) as pilot:
        await ready(app, pilot)
        app.push_screen(FinishScreen(tmp_path, is_open=False))
        text = await ready(app, pilot)
        assert "✓ sound" in text
        await pilot.press("c")
        text = await ready(app, pilot)
        assert ran == [("calibrate", tmp_path)]
        assert "line 29" in text
    assert "! damaged" in verdict_content(Verdict("s", "closed", findings={"a.mcap": ["is cut"]})).plain


def test_a_session_that_cannot_be_calibrated_fitted_or_validated_says_why_and_the_screen_stays(tmp_path: Path) -> None:
    for name in ("calibrate", "fit", "validate"):
        code, said = run_command(name, tmp_path / "nowhere", lambda _what, _done, _total: None)
        assert code == 2
        assert "nowhere" in said


def test_pictures_work_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "textual_image", None)
    assert isinstance(Pictures("auto").make("x"), CellPicture)


def test_a_pixel_is_a_dot_of_its_own_colour_on_the_colour_of_most() -> None:
    paper = np.full((4, 4), 255, np.uint8)
    paper[0, 0] = paper[3, 3] = 0
    [line] = [Cells(paper, Size(2, 1)).strip(0)]
    assert line.text == "⠁⢀"
    numbers = np.zeros((4, 4), np.uint8)
    numbers[:, 2] = 1
    numbers[1, 3] = 2
    colours = np.array(((255, 255, 255), (0, 0, 0), (0, 114, 178)), np.uint8)
    strip = Cells(colours[numbers], Size(2, 1)).strip(0)
    assert strip.text[0] == "⠀"
    assert {str(part.style) for part in strip} == {
        "rgb(255,255,255) on rgb(255,255,255)",
        "rgb(255,255,255) on rgb(0,0,0)",
    }


def test_the_noise_of_a_camera_is_not_drawn_and_a_change_is() -> None:
    rng = np.random.default_rng(0)

    def frame(gray: float) -> NDArray[np.uint8]:
        return np.clip(rng.normal(gray, 3.0, (160, 320)), 0, 255).astype(np.uint8)

    dark = Cells(frame(100.0), Size(64, 16))
    again, brighter = Cells(frame(100.0), Size(64, 16), dark), Cells(frame(115.0), Size(64, 16), dark)
    assert dark.codes is not None
    assert again.codes is not None
    assert brighter.codes is not None
    assert (again.codes == dark.codes).mean() > 0.95
    assert (brighter.codes != dark.codes).mean() > 0.95


def test_a_force_is_drawn_to_scale_and_noise_does_not_fill_its_place() -> None:
    assert spark([0.0, 0.5, 1.0], 4) == "  ▄█"
    assert spark([0.001, 0.0], 2) == "▁ "
    assert [scale_n([force_n]) for force_n in (0.0, 0.04, 0.11, 0.9, 3.0)] == [0.1, 0.1, 0.2, 1.0, 5.0]
    assert plot([0.0, 1.0], 10, 2).plain == "    1 N┤ █\n    0 N┤ █"
    assert plot([0.0, 1.0], 10, 2, ceiling_n=0.6).plain == "    1 N┤╌█\n    0 N┤ █"
    assert "5 N" in plot_title(5.0)
