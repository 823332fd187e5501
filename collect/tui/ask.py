"""A question of the engine, with the picture that caused it and its answers on keys. The stop keys go on working over
it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import Static

from collect.engine.snapshot import EngineView
from collect.operator import Prompt
from collect.tui.line import Line
from collect.tui.pictures import Pictures
from collect.tui.text import plain

LEAVE_LINE = "q  leave: park the arm, answer nothing"
STOP_LINE = "s  stop the arm now: software stop; red button: emergency stop"


class AskScreen(ModalScreen[None]):
    """Shows one prompt until it is answered, here or by its timeout."""

    DEFAULT_CSS = """
    AskScreen { align: center middle; }
    AskScreen Vertical {
        width: 90%; max-width: 76; height: auto; max-height: 95%; padding: 0 2;
        border: heavy $warning; background: $surface; overflow-y: auto;
    }
    AskScreen #question { text-style: bold; margin-bottom: 1; }
    AskScreen #cause { height: 9; margin-bottom: 1; }
    AskScreen #left { color: $text-muted; }
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "app.quit", "Leave"),
        Binding("question_mark", "app.help", "Help"),
    ]

    def __init__(
        self, prompt: Prompt, engine: EngineView, pictures: Pictures, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__()
        self.prompt = prompt
        self._engine = engine
        self._pictures = pictures
        self._now_s = now_s
        self._left = Line("left")
        self.tell_time()

    def compose(self) -> ComposeResult:
        """The question, its picture, and a line for each answer."""
        with Vertical():
            yield Static(plain(self.prompt.question), id="question", markup=False)
            if self.prompt.image is not None:
                picture = self._pictures.make("cause")
                picture.show(self.prompt.image)
                yield picture
            yield Static(choices_content(self.prompt), markup=False)
            yield Static(LEAVE_LINE, markup=False)
            yield Static(STOP_LINE, markup=False)
            yield self._left

    def on_key(self, event: events.Key) -> None:
        """An answer's key answers."""
        if any(choice.key == event.character for choice in self.prompt.choices):
            event.stop()
            self._engine.answer(self.prompt.number, str(event.character))

    def tell_time(self) -> None:
        """How long the default still waits."""
        self._left.show(timeout_text(self.prompt, self._now_s()))


def choices_content(prompt: Prompt) -> Content:
    """A line for each answer; the default is marked where it is taken by itself."""
    lines: list[Content] = []
    for choice in prompt.choices:
        timed = prompt.timeout_s is not None and choice.key == prompt.default
        mark = "   (if nobody answers)" if timed else ""
        lines.append(Content.assemble((choice.key, "bold $text-accent"), f"  {plain(choice.label)}{mark}"))
    return Content("\n").join(lines)


def timeout_text(prompt: Prompt, now_s: float) -> str:
    """How long the default still waits, or that it waits for ever."""
    if prompt.timeout_s is None:
        return "Waits until it is answered; the arm does not move meanwhile."
    return f"{max(0.0, prompt.timeout_s - (now_s - prompt.asked_s)):.0f} s left"
