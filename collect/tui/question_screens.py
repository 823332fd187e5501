"""Questions to the operator: the engine's, with its picture and its answers on keys, and the screen's own yes or no.

The stop keys work over both.
"""

from __future__ import annotations

from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import Static

from brushloop.collect.errors import NOT_AT_REST
from brushloop.collect.headless import RunnableEngine
from brushloop.collect.operator import Prompt
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.text import plain
from brushloop.collect.tui.widgets import Line

LEAVE_LINE = "q  leave: park the arm, answer nothing"
STOP_LINE = "s  stop the arm now: software stop; red button: emergency stop"
LEAVE_KEYS = "y  leave it as it is      n  stay"
AT_WORK = (
    "A run is in progress. Finish its step, park the arm, and leave?",
    "y  park and leave      n  go on      s  stop now",
)
NOT_PARKED = (
    "The arm is not parked: it rests where it was stopped, perhaps with the brush down. "
    "The next run begins by lifting it. Leave it as it is?",
    LEAVE_KEYS,
)
UNSEEN = (f"{NOT_AT_REST} Leave this screen anyway?", LEAVE_KEYS)


class AskScreen(ModalScreen[None]):
    """Shows one prompt of the engine until it is answered."""

    DEFAULT_CSS = """
    AskScreen { align: center middle; }
    AskScreen Vertical {
        width: 90%; max-width: 76; height: auto; max-height: 95%; padding: 0 2;
        border: heavy $warning; background: $surface; overflow-y: auto;
    }
    AskScreen #question { text-style: bold; margin-bottom: 1; }
    AskScreen #cause { height: 9; margin-bottom: 1; }
    AskScreen #live { height: auto; margin: 1 0; background: $boost; text-wrap: nowrap; }
    AskScreen #left { color: $text-muted; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "app.quit", "Leave"),
        Binding("question_mark", "app.help", "Help"),
    ]

    def __init__(self, prompt: Prompt, engine: RunnableEngine, pictures: Pictures) -> None:
        super().__init__()
        self.prompt = prompt
        self._engine = engine
        self._pictures = pictures
        self._live = Line("live")

    def compose(self) -> ComposeResult:
        """Lay out the question, its picture, and a line for each answer."""
        with Vertical():
            yield Static(plain(self.prompt.question), id="question", markup=False)
            if self.prompt.image is not None:
                picture = self._pictures.make("cause")
                picture.show(self.prompt.image)
                yield picture
            yield Static(_choices_content(self.prompt), markup=False)
            yield self._live
            yield Static(LEAVE_LINE, markup=False)
            yield Static(STOP_LINE, markup=False)
            yield Static("Waits until it is answered; the arm does not move meanwhile.", id="left", markup=False)

    def on_key(self, event: events.Key) -> None:
        """Answer, if it is the key of an answer."""
        if any(choice.key == event.character for choice in self.prompt.choices):
            event.stop()
            self._engine.answer(self.prompt.number, str(event.character))

    def show(self, live: Content) -> None:
        """Show where the arm is and what it feels: a person who jogs, or turns the lens, watches that."""
        self._live.show(live)


def _choices_content(prompt: Prompt) -> Content:
    """A line for each answer."""
    return Content("\n").join(
        Content.assemble((choice.key, "bold $text-accent"), f"  {plain(choice.label)}") for choice in prompt.choices
    )


class Confirm(ModalScreen[bool]):
    """A question of the screen itself with yes and no; true for yes."""

    DEFAULT_CSS = """
    Confirm { align: center middle; }
    Confirm Vertical {
        width: 90%; max-width: 64; height: auto; padding: 1 2; border: heavy $warning; background: $surface;
    }
    Confirm Static { text-align: center; }
    Confirm #question { text-style: bold; margin-bottom: 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "dismiss(True)", "Yes"),
        Binding("n,escape", "dismiss(False)", "No"),
    ]

    def __init__(self, question: str, keys: str) -> None:
        super().__init__()
        self._question = question
        self._keys = keys

    def compose(self) -> ComposeResult:
        """Lay out the question and its keys."""
        with Vertical():
            yield Static(self._question, id="question", markup=False)
            yield Static(self._keys, id="keys", markup=False)
