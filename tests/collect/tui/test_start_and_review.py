"""The screens around a run: start, review, finish, pictures."""

from __future__ import annotations

import builtins
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from textual.app import App
from textual.geometry import Size
from textual.pilot import Pilot

from collect.errors import ConfigError
from collect.tui.app import OperatorApp
from collect.tui.finish_screen import FinishScreen, run_command, verdict_content
from collect.tui.pictures import HALF, CellPicture, ImagePicture, Pictures, half_cells
from collect.tui.question_screens import Confirm
from collect.tui.start_screen import StartScreen
from collect.tui.text import force_bar, plot, spark
from sessions.remarks import remarks_of
from sessions.repair.verify import Finding, Verdict
from tests.collect.tui.fake import FakeEngine, picture
from tests.collect.tui.fake_browser import FakeBrowser, a_review
from tests.collect.tui.screen_text import shown
from tests.collect.tui.test_app import look


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


async def test_the_first_day_says_what_to_do() -> None:
    app = OperatorApp(browser=FakeBrowser(rows=()))
    async with app.run_test(size=(80, 24)) as pilot:
        text = await ready(app, pilot)
        assert "No session yet" in text
        assert "q leave" in text
        await pilot.press("s", "q")
    assert app.return_code == 0


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


async def test_other_files_can_be_typed_and_letters_of_stop_keys_too() -> None:
    browser = FakeBrowser()
    app = OperatorApp(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        await ready(app, pilot)
        await pilot.press("e", "ctrl+u", *"s2.toml", "enter")
        await ready(app, pilot)
        assert str(browser.paths.config) == "s2.toml"
        assert isinstance(app.screen, StartScreen)


async def test_escape_leaves_the_files_as_they_were() -> None:
    browser = FakeBrowser()
    app = OperatorApp(browser=browser)
    async with app.run_test(size=(80, 24)) as pilot:
        before = browser.paths
        await ready(app, pilot)
        await pilot.press("e", *"xx")
        assert "escape keep the old files" in await ready(app, pilot)
        await pilot.press("escape")
        text = await ready(app, pilot)
        assert str(before.config) in text
        assert f"{before.config}xx" not in text
        assert "q leave" in text
        assert browser.paths == before


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
            HALF,
        ):
            assert part in text
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


async def test_no_note_is_typed_while_the_arm_is_at_work(tmp_path: Path) -> None:
    engine = FakeEngine(picture())
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        await look(app, pilot)
        review = a_review(tmp_path, lambda: app.at_work)
        app.push_screen(review)
        text = await ready(app, pilot)
        for words in ("The arm is at work", "red button", "s STOP"):
            assert words in text
        assert "o note" not in text
        await pilot.press("o", "s")
        assert engine.calls == ["stop"]
        assert not review.has_class("-noting")


async def test_finishing_verifies_and_runs_what_comes_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[tuple[str, Path]] = []

    def command(name: str, folder: Path, on_line: Callable[[str], None]) -> tuple[int, str]:
        ran.append((name, folder))
        on_line("captures: 3 of 30, about 5 s left")
        return 0, "\n".join(f"line {n}" for n in range(30))

    monkeypatch.setattr("collect.tui.finish_screen.run_command", command)
    monkeypatch.setattr("collect.tui.finish_screen.verify", lambda _folder: Verdict("s", "closed", files=3, strokes=2))
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
    assert "! damaged" in verdict_content(Verdict("s", "closed", findings=[Finding("a.mcap", "is cut")])).plain


def test_a_command_shows_its_progress_and_keeps_it_where_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    program = "import sys; print('said'); print('3 of 30', file=sys.stderr); sys.exit(int(sys.argv[1] == 'fail'))"
    lines: list[str] = []
    popen = subprocess.Popen

    def started(command: list[str], **options: Any) -> subprocess.Popen[str]:
        return popen([sys.executable, "-c", program, command[3]], **options)

    monkeypatch.setattr(subprocess, "Popen", started)
    assert run_command("work", Path("s"), lines.append) == (0, "said")
    assert run_command("fail", Path("s"), lines.append) == (1, "said\n3 of 30")
    assert lines == ["3 of 30", "3 of 30"]


def test_pictures_work_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    imports = builtins.__import__

    def missing(name: str, *rest: Any) -> Any:
        if name.startswith("textual_image"):
            raise ImportError(name)
        return imports(name, *rest)

    monkeypatch.setattr(builtins, "__import__", missing)
    assert isinstance(Pictures("auto").make("x"), CellPicture)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:textual_image")
async def test_pictures_by_the_extra_are_shown_and_changed() -> None:
    widget = pytest.importorskip("textual_image.widget").HalfcellImage
    app: App[None] = App()
    async with app.run_test(size=(80, 24)) as pilot:
        shows = ImagePicture(widget, "x")
        await app.screen.mount(shows)
        for image in (np.zeros((20, 40), np.uint8), np.full((20, 40), 255, np.uint8), None):
            shows.show(image)
            await pilot.pause()
        assert app.is_running


def test_a_picture_fits_its_place_and_keeps_its_shape() -> None:
    image = np.tile(np.arange(64, dtype=np.uint8) * 4, (32, 1))
    pairs = half_cells(image, Size(40, 30))
    assert pairs is not None
    assert pairs.shape == (10, 40)
    assert half_cells(None, Size(40, 30)) is None
    assert half_cells(image, Size(0, 0)) is None


def test_the_noise_of_a_camera_is_not_drawn_and_a_change_is() -> None:
    rng = np.random.default_rng(0)

    def frame(gray: float) -> NDArray[np.uint8]:
        return np.clip(rng.normal(gray, 3.0, (160, 320)), 0, 255).astype(np.uint8)

    dark = half_cells(frame(100.0), Size(64, 16))
    assert dark is not None
    assert (half_cells(frame(100.0), Size(64, 16), dark) == dark).mean() > 0.95
    assert (half_cells(frame(115.0), Size(64, 16), dark) != dark).mean() > 0.95


def test_a_force_is_drawn_to_scale_and_noise_does_not_fill_its_place() -> None:
    assert spark([0.0, 0.5, 1.0], 4) == "  ▄█"
    assert spark([0.001, 0.0], 2) == "▁ "
    assert plot([0.0, 1.0], 2, 2).plain == " █\n █"
    assert force_bar(0.05, 0.1, 10) == "█████░░░░░   0.050 N"
    assert force_bar(9.0, 0.1, 4) == "████   9.000 N"
    assert force_bar(None, 0.1, 4) == "no force sensor"
