"""Text that is drawn again only when it changed, and never read as markup."""

from __future__ import annotations

from textual.content import Content
from textual.widgets import Static


class Line(Static):
    """A `Static` for literal text."""

    def __init__(self, place: str, classes: str | None = None) -> None:
        super().__init__(id=place, classes=classes, markup=False)
        self._shown: Content | None = None

    def show(self, content: Content | str) -> None:
        """Draw, if new."""
        content = Content(content) if isinstance(content, str) else content
        if self._shown is None or not content.is_same(self._shown):
            self._shown = content
            self.update(content)
