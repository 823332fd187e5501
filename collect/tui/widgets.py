"""Parts that several screens use: text that is drawn only when it changed, a list, the line of keys, the help page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, cast

from rich.cells import cell_len
from textual import events
from textual.app import App, ComposeResult, RenderResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.content import Content
from textual.dom import DOMNode
from textual.screen import ModalScreen
from textual.widget import Widget
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

Key = tuple[str, str]
"""The key and what it does."""
KEY_NAMES = {"?": "question_mark", "→": "right", "ctrl-p": "ctrl+p", "esc": "escape"}
"""Textual's names of keys that are shown by another."""
NARROW_COLUMNS = 110
"""Width from which a picture has room beside the text."""
GAP = 2
CURSOR, ELSEWHERE = "›", " "


def app_of(node: DOMNode) -> App[None]:
    """The app that a widget is in, with a type."""
    return cast("App[None]", node.app)  # pyright: ignore[reportUnknownMemberType]


class Line(Static):
    """Literal text, never read as markup, drawn again only when it changed."""

    def __init__(self, place: str, classes: str | None = None, *, sized: bool = False) -> None:
        """`sized`: its size does not depend on its text, so that new text moves nothing."""
        super().__init__(id=place, classes=classes, markup=False)
        self._shown: Content | None = None
        self._sized = sized

    def show(self, content: Content | str) -> None:
        """Draw this text, if it is new."""
        content = Content(content) if isinstance(content, str) else content
        if self._shown is None or not content.is_same(self._shown):
            self._shown = content
            self.update(content, layout=not self._sized)


def entitle(widget: Widget, title: str) -> None:
    """Set the title in a widget's border, if it is new: textual draws the whole widget again."""
    if widget.border_title != title:
        widget.border_title = title


class Rows(OptionList):
    """A list whose row under the cursor carries a sign as well as a colour, for terminals without colours."""

    def __init__(self, id: str) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id, markup=False)
        self._rows: list[Content] = []
        self._signed: int | None = None

    def fill(self, rows: Sequence[tuple[str | None, Content]]) -> None:
        """Replace all rows: the id of each, and its text."""
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


class KeyBar(Widget):
    """The line of keys at the bottom of a screen: as many as fit, in the order given."""

    DEFAULT_CSS = """
    KeyBar { dock: bottom; height: 1; background: $panel; color: $foreground; text-wrap: nowrap; padding: 0 1; }
    """

    def __init__(self, keys: Sequence[Key] = ()) -> None:
        super().__init__()
        self._keys = tuple(keys)
        self._places: list[tuple[str, int, int]] = []
        """Each key that is drawn, with its first column and the one after its last."""

    def show(self, keys: Sequence[Key]) -> None:
        """Replace the keys, if they differ."""
        if tuple(keys) != self._keys:
            self._keys = tuple(keys)
            self.refresh()

    def on_click(self, event: events.Click) -> None:
        """Do what the key under the pointer does."""
        # One column of padding.
        key = next((key for key, start, end in self._places if start <= event.x - 1 < end), None)
        if key is not None:
            app_of(self).simulate_key(KEY_NAMES.get(key, key))

    def render(self) -> RenderResult:
        """Draw `s STOP  space pause  q leave ...` as far as it fits."""
        parts: list[Content] = []
        self._places = []
        used = 0
        for key, label in self._keys:
            width = cell_len(key) + 1 + cell_len(label)
            if used + width > self.size.width:
                break
            parts.append(Content.assemble((key, "bold $text-accent"), f" {label}"))
            self._places.append((key, used, used + width))
            used += width + GAP
        return Content(" " * GAP).join(parts)


class HelpScreen(ModalScreen[None]):
    """Every key on one page; escape, q, ? and Enter close it."""

    DEFAULT_CSS = """
    HelpScreen { align: center middle; }
    HelpScreen VerticalScroll {
        width: 80; max-width: 100%; height: auto; max-height: 100%; padding: 0 1;
        border: heavy $accent; background: $surface;
    }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,question_mark,enter", "dismiss(None)", "Close")]

    def __init__(self, text: str) -> None:
        super().__init__()
        self._text = text

    def compose(self) -> ComposeResult:
        """Lay out the page."""
        with VerticalScroll() as page:
            page.border_title = "Help, escape closes"
            yield Static(self._text, markup=False)
