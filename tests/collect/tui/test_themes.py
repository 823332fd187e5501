"""The colours of the screens: chosen in the palette, and kept for the next start."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.themes import DARK, LIGHT, SAFE, chosen, chosen_file, keep
from tests.collect.tui.fake import FakeEngine, picture


async def test_a_choice_of_colours_is_there_at_the_next_start(tmp_path: Path) -> None:
    file = tmp_path / "brushloop" / "theme"
    app = OperatorApp(FakeEngine(picture()), theme_file=file)
    async with app.run_test():
        assert app.theme == DARK
        commands = {command.title: command.callback for command in app.get_system_commands(app.screen)}
        assert "Dark colours" not in commands
        commands["Colour-blind safe colours"]()
        assert app.theme == SAFE
    assert OperatorApp(FakeEngine(picture()), theme_file=file).theme == SAFE


def test_a_file_that_holds_anything_else_is_dark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "theme"
    assert chosen(file) == chosen(None) == DARK
    file.write_bytes(b"\xff" * 1000)
    assert chosen(file) == DARK
    keep(file, LIGHT)
    assert chosen(file) == LIGHT
    keep(file / "below a file", SAFE)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert chosen_file() == tmp_path / "brushloop" / "theme"
