"""What a screen shows, as text: read from the picture that textual exports of it."""

from __future__ import annotations

import html
import re

from rich.cells import cell_len
from textual.app import App

CHAR_PX = 12.2
"""Width of a cell in that picture."""


def has_picture(text: str) -> bool:
    """Whether a picture is among it: braille with dots."""
    return any("\u2801" <= sign <= "\u28ff" for sign in text)


def shown(app: App[None]) -> str:
    """The lines of the screen, without blanks at their ends."""
    width, height = app.size
    lines = [""] * height
    svg = app.export_screenshot()
    for tag, text in re.findall(r"<text ([^>]*clip-path[^>]*)>(.*?)</text>", svg, re.DOTALL):
        x, line = re.search(r'\bx="([\d.]+)"', tag), re.search(r"-line-(\d+)\)", tag)
        assert x is not None
        assert line is not None
        before, column = lines[int(line[1])], round(float(x[1]) / CHAR_PX)
        lines[int(line[1])] = (
            before + " " * (column - cell_len(before)) + html.unescape(text).replace("\xa0", " ").rstrip("\n")
        )
    assert max(map(cell_len, lines)) <= width
    return "\n".join(lines)
