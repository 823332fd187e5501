"""A rich console on which foreign text cannot act: no markup, and no control character but the console's own."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console  # noqa: TID251 - the one place
from rich.segment import Segment
from rich.text import Text

from sessions.terminal import plain


class PlainConsole(Console):
    """For tables and progress bars; what they hold may come from anywhere. A colour is given as a style."""

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """Make text of a string before it is laid out, so that columns are as wide as what is shown."""
        return super().render_str(plain(text, keep="\n"), **options)

    def _render_buffer(self, buffer: Iterable[Segment]) -> str:
        # Texts and columns that were not made by `render_str` pass here too.
        return super()._render_buffer(
            part if part.control else Segment(plain(part.text, keep="\n"), part.style) for part in buffer
        )
