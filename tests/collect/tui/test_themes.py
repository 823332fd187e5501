"""The colours of the screens: chosen in the palette, and kept for the next start."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.terminal import DARK, chosen_theme, theme_file
from tests.collect.tui.fake import FakeEngine, picture


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


def test_a_file_that_holds_anything_else_is_dark(tmp_path: Path) -> None:
    file = tmp_path / "theme"
    assert chosen_theme(file) == chosen_theme(None) == DARK
    file.write_bytes(b"\xff" * 1000)
    assert chosen_theme(file) == DARK
