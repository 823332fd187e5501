"""Questions to the operator, with their answers on keys or typed: the engine's, and the screen's own.

The stop keys work over all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.content import Content
from textual.screen import ModalScreen
from textual.widgets import Footer, Input, Static

from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.widgets import HELP_KEY, STOP, Line, app_of, plain

YES, NO = "y", "n"


def yes_or_no(question: str, yes: str, no: str) -> Prompt:
    """A question of the screen itself; escape means no."""
    return Prompt(question, (Choice(YES, yes), Choice(NO, no)), NO)


class AskScreen(ModalScreen[str]):
    """One question. The engine's stays until the engine has its answer; the screen's own ends with the key, or with the
    typed line. Escape ends it with None."""

    DEFAULT_CSS = """
    AskScreen { align: center middle; }
    AskScreen Vertical {
        width: 90%; max-width: 76; height: auto; max-height: 95%; padding: 0 2;
        border: heavy $warning; background: $surface; overflow-y: auto;
    }
    AskScreen #question { margin-bottom: 1; }
    AskScreen #cause { height: 9; margin-bottom: 1; }
    AskScreen #live { height: auto; margin: 1 0; background: $boost; text-wrap: nowrap; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("q", "leave", "Leave: park the arm, answer nothing"),
        Binding("escape", "dismiss", "Back"),
        HELP_KEY,
    ]

    def __init__(
        self, prompt: Prompt, answer: Callable[[str], object] | None = None, pictures: Pictures | None = None
    ) -> None:
        """`answer` passes a key on to the engine; without it the question is the screen's own."""
        super().__init__()
        self.prompt = prompt
        self._answer = answer
        self._pictures = pictures or Pictures()
        self._live = Line("live")

    @property
    def own(self) -> bool:
        """Whether the screen itself asks, not the engine."""
        return self._answer is None

    def compose(self) -> ComposeResult:
        """Lay out the question, its picture, and a line for each answer or for the one that is typed."""
        with Vertical():
            yield Static(question_content(self.prompt), id="question", markup=False)
            if self.prompt.image is not None:
                picture = self._pictures.make("cause")
                picture.show(self.prompt.image)
                yield picture
            if self.prompt.read is not None:
                yield Input(self.prompt.default, id="answer", compact=True, select_on_focus=False)
            if not self.own:
                yield self._live
                yield Static("Waits until it is answered; the arm does not move meanwhile.", markup=False)
        yield Footer(compact=True)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Escape ends only the screen's own questions, and q leaves only the engine's."""
        if action in ("dismiss", "leave"):
            return self.own is (action == "dismiss")
        return super().check_action(action, parameters)

    def on_key(self, event: events.Key) -> None:
        """Answer, if it is the key of an answer."""
        if self.prompt.answer_to(event.character or "") is not None:
            event.stop()
            (self._answer or self.dismiss)(str(event.character))

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Answer with the typed line."""
        self.dismiss(event.value)

    async def action_leave(self) -> None:
        """Leave the run, whatever is asked."""
        await app_of(self).action_quit()

    def show(self, live: Content) -> None:
        """Show where the arm is and what it feels: a person who jogs, or turns the lens, watches that."""
        self._live.show(live)


def question_content(prompt: Prompt) -> Content:
    """The question, a line for each answer, and what else is allowed."""
    lines = [Content.styled(plain(prompt.question), "bold")]
    for choice in prompt.choices:
        mark = "   (Enter)" if prompt.default == choice.key and "enter" in prompt.answers else ""
        lines.append(Content.assemble((choice.key, "bold $text-accent"), f"  {plain(choice.label)}{mark}"))
    return Content("\n").join([*lines, Content(plain(prompt.allowed))] if prompt.allowed else lines)
