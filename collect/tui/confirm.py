"""Questions of the screen itself: leave while the arm is at work, or where it is not parked?"""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Static

AT_WORK = "The arm is at work. Finish this step, park the arm, and leave?"
AT_WORK_KEYS = "y  park and leave      n  go on      s  stop now"
NOT_PARKED = (
    "The arm is not parked: it rests where it was stopped, perhaps with the brush down. "
    "The next run begins by lifting it. Leave it so?"
)
NOT_AT_REST = (
    "The arm was not seen at rest: it may still be moving. Use the emergency stop, the red button. "
    "Leave this screen all the same?"
)
NOT_PARKED_KEYS = "y  leave it so      n  stay"


class Confirm(ModalScreen[bool]):
    """A question with yes and no; true for yes. The stop keys of the app go on working over it."""

    DEFAULT_CSS = """
    Confirm { align: center middle; }
    Confirm Vertical {
        width: 90%; max-width: 64; height: auto; padding: 1 2; border: heavy $warning; background: $surface;
    }
    Confirm Static { text-align: center; }
    Confirm #question { text-style: bold; margin-bottom: 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "answer(True)", "Yes"),
        Binding("n,escape", "answer(False)", "No"),
    ]

    def __init__(self, question: str, keys: str = "y  yes      n  no") -> None:
        super().__init__()
        self._question = question
        self._keys = keys

    def compose(self) -> ComposeResult:
        """The question and its keys."""
        with Vertical():
            yield Static(self._question, id="question", markup=False)
            yield Static(self._keys, id="keys", markup=False)

    def action_answer(self, yes: bool) -> None:
        """Close with the answer."""
        self.dismiss(yes)
