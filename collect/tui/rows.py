"""A list whose row under the cursor carries a sign: told by colour alone it could not be seen without colours."""

from __future__ import annotations

from collections.abc import Sequence

from textual.content import Content
from textual.widgets import OptionList
from textual.widgets.option_list import Option

CURSOR, ELSEWHERE = "›", " "


class Rows(OptionList):
    """Rows of text, one of them under the cursor."""

    def __init__(self, id: str) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id, markup=False)
        self._rows: list[Content] = []
        self._signed: int | None = None

    def fill(self, rows: Sequence[tuple[str | None, Content]]) -> None:
        """Other rows: the id of each, and what it shows."""
        self._rows, self._signed = [content for _, content in rows], None
        self.clear_options()
        self.add_options(Option(Content.assemble(ELSEWHERE, content), id=name) for name, content in rows)

    def watch_highlighted(self, highlighted: int | None) -> None:
        """Move the sign with the cursor."""
        super().watch_highlighted(highlighted)
        for index, sign in ((self._signed, ELSEWHERE), (highlighted, CURSOR)):
            if index is not None and index < len(self._rows):
                self.replace_option_prompt_at_index(index, Content.assemble(sign, self._rows[index]))
        self._signed = highlighted
