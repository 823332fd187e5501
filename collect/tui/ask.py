"""A question of the engine, with its answers on keys. The stop keys go on working over it."""

from __future__ import annotations

import time

from textual import events
from textual.app import ComposeResult
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Static

from collect.asking import Prompt
from collect.snapshot import EngineView


class AskScreen(ModalScreen[None]):
    """Shows one prompt until it is answered, here or by its timeout."""

    DEFAULT_CSS = """
    AskScreen { align: center middle; }
    AskScreen Vertical {
        width: 90%; max-width: 76; height: auto; max-height: 90%; padding: 1 2;
        border: heavy $warning; background: $surface; overflow-y: auto;
    }
    AskScreen #question { text-style: bold; margin-bottom: 1; }
    AskScreen #left { margin-top: 1; color: $text-muted; }
    """

    def __init__(self, prompt: Prompt, engine: EngineView) -> None:
        super().__init__()
        self.prompt = prompt
        self._engine = engine

    def compose(self) -> ComposeResult:
        """The question, and a line for each answer."""
        with Vertical():
            yield Static(self.prompt.question, id="question", markup=False)
            for choice in self.prompt.choices:
                timed = self.prompt.timeout_s is not None and choice.key == self.prompt.default
                mark = "   (if nobody answers)" if timed else ""
                yield Static(f"{choice.key}  {choice.label}{mark}", markup=False)
            yield Static("s  stop the arm now. The red button is the emergency stop.", markup=False)
            yield Static("", id="left", markup=False)

    def on_key(self, event: events.Key) -> None:
        """An answer's key answers."""
        if any(choice.key == event.character for choice in self.prompt.choices):
            event.stop()
            self._engine.answer(self.prompt.number, str(event.character))

    def tell_time(self) -> None:
        """How long the default still waits."""
        if self.prompt.timeout_s is not None:
            left_s = max(0.0, self.prompt.timeout_s - (time.monotonic() - self.prompt.asked_s))
            self.query_one("#left", Static).update(f"{left_s:.0f} s left")
