"""What a screen shows, as text: the picture that textual exports of it, without its colours."""

from __future__ import annotations

from unittest.mock import patch

from rich.cells import cell_len
from rich.console import Console  # noqa: TID251
from textual.app import App
from textual.pilot import Pilot

from brushloop.collect.tui.app import OperatorApp
from tests.collect.tui.fake import FakeEngine


def has_picture(text: str) -> bool:
    """Whether a picture is among it: braille with dots."""
    return any("\u2801" <= sign <= "\u28ff" for sign in text)


def shown(app: App[None]) -> str:
    """The lines of the screen, without blanks at their ends; fewer of them while a new screen has no layout yet.

    Drawing them as SVG takes five times as long.
    """
    with patch.object(Console, "export_svg", lambda console, **_style: console.export_text()):
        lines = [line.rstrip() for line in app.export_screenshot().splitlines()]
    assert len(lines) <= app.size.height
    assert all(cell_len(line) <= app.size.width for line in lines)
    return "\n".join(lines)


async def look(app: OperatorApp, pilot: Pilot[None]) -> str:
    """The screen after two polls: the first may come before the layout has its sizes."""
    engine = app.engine
    assert isinstance(engine, FakeEngine)
    enough = engine.looks + 2
    while engine.looks < enough:
        await pilot.pause(0.02)
    await pilot.pause()
    return shown(app)
