"""The common layout of set-up and first day: steps at the left, findings, a picture, live figures, the question."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widget import Widget

from brushloop.collect.tui.pictures import AnyPicture
from brushloop.collect.tui.widgets import Key, KeyBar, Line

NARROW_COLUMNS = 110
"""Width from which a picture has room beside the text."""


class StepsScreen(Screen[None]):
    """Lays out the parts; what they show is for its subclasses."""

    DEFAULT_CSS = """
    StepsScreen #title {
        height: 1; padding: 0 1; background: $panel; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
    }
    StepsScreen #body { height: 1fr; }
    StepsScreen #steps {
        width: 27; height: 100%; padding: 0 1; border-right: solid $foreground 40%;
        text-wrap: nowrap; text-overflow: ellipsis;
    }
    StepsScreen #found { width: 1fr; height: 1fr; padding: 0 1; }
    StepsScreen #picture { width: 36%; height: 100%; padding: 0 1; }
    StepsScreen.-narrow #picture { display: none; }
    StepsScreen.-narrow.-picture #picture { display: block; width: 1fr; }
    StepsScreen.-narrow.-picture #found-pane { display: none; }
    StepsScreen #live { height: auto; padding: 0 1; background: $boost; text-wrap: nowrap; }
    StepsScreen #question-box { height: auto; max-height: 13; padding: 0 1; border: heavy $warning; display: none; }
    StepsScreen.-asking #question-box { display: block; }
    StepsScreen #note { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("tab", "picture", "Picture", priority=True)]

    def __init__(self, picture: AnyPicture | None, keys: Iterable[Key]) -> None:
        """`picture` is None where there is never a picture."""
        super().__init__()
        self._title, self._steps, self._found = Line("title"), Line("steps"), Line("found-text")
        self._live, self._asked, self._note = Line("live"), Line("question-text"), Line("note")
        self._picture = picture
        self._keys = KeyBar(tuple(keys))
        self._found_pane = VerticalScroll(id="found")
        self._found_pane.can_focus = False

    def compose(self) -> ComposeResult:
        """Lay out the parts from top to bottom."""
        yield self._title
        with Horizontal(id="body"):
            yield self._steps
            with Vertical(id="found-pane"), self._found_pane:
                yield self._found
            if self._picture is not None:
                yield self._picture
        yield self._live
        with VerticalScroll(id="question-box") as box:
            box.can_focus = False
            yield self._asked
            yield from self.below_the_question()
        yield self._note
        yield self._keys

    def below_the_question(self) -> Iterable[Widget]:
        """Widgets that are shown with the question."""
        return ()

    def on_resize(self, event: events.Resize) -> None:
        """Show the picture beside the findings where there is room."""
        self.set_class(event.size.width < NARROW_COLUMNS, "-narrow")

    def on_key(self, event: events.Key) -> None:
        """Scroll the findings, unless a subclass has used the key."""
        if event.key in ("pageup", "pagedown"):
            event.stop()
            (self._found_pane.scroll_page_up if event.key == "pageup" else self._found_pane.scroll_page_down)()

    def action_picture(self) -> None:
        """Show the picture instead of the findings, on a narrow screen."""
        self.toggle_class("-picture")
        self.call_after_refresh(self._found_pane.scroll_end, animate=False)  # what was hidden could not be scrolled

    def stop_sent(self) -> None:
        """Show at once that a stop key was pressed."""
        self._note.show(Content.styled(" STOP SENT ", "bold reverse"))
