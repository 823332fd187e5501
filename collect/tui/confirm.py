"""The one question that the screen asks: leave while the arm is at work?"""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Static


class ConfirmQuit(ModalScreen[bool]):
    """`Stop the arm and quit?`; true for yes. The stop keys of the app go on working under it."""

    DEFAULT_CSS = """
    ConfirmQuit { align: center middle; }
    ConfirmQuit Vertical {
        width: 46; height: auto; padding: 1 2; border: heavy $warning; background: $surface;
    }
    ConfirmQuit Static { text-align: center; }
    ConfirmQuit #question { text-style: bold; margin-bottom: 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "answer(True)", "Stop the arm and quit"),
        Binding("n,escape", "answer(False)", "Go on"),
    ]

    def compose(self) -> ComposeResult:
        """The question and its keys."""
        with Vertical():
            yield Static("Stop the arm and quit?", id="question", markup=False)
            yield Static("y  stop and quit      n  go on", id="keys", markup=False)

    def action_answer(self, yes: bool) -> None:
        """Close with the answer."""
        self.dismiss(yes)
