"""What several screens use: literal text that is drawn only when it changed, values in words, and questions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, ClassVar, cast

from textual import events
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.content import Content
from textual.dom import DOMNode
from textual.screen import ModalScreen
from textual.signal import Signal
from textual.widgets import Footer, Input, OptionList, Static
from textual.widgets.option_list import Option

from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.pictures import picture_widget
from brushloop.sessions import terminal

if TYPE_CHECKING:
    from brushloop.sessions.records import Condition

SOFTWARE_STOP = "s is a software stop. The red button is the emergency stop."
SHORT_STOP = "s: software stop; red button: emergency stop"
STOP = Binding("s", "app.stop", "STOP", tooltip="Stop the arm at once, on every screen and during every question")
"""Shown first on every screen while the arm may move. The app takes this key and ctrl-c before any screen sees them."""
HELP_KEY = Binding("question_mark", "app.help", "Help", key_display="?", tooltip="Show or hide this screen's keys")


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


class Bar(Line):
    """A line across the screen: its title, or what to do now."""

    DEFAULT_CSS = """
    Bar { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; text-overflow: ellipsis; }
    Bar#title { text-style: bold; }
    """

    def __init__(self, place: str) -> None:
        super().__init__(place, sized=True)


class Newest(VerticalScroll, inherit_bindings=False):
    """Stays at its newest line until the operator pages back; has few keys, so that the help lists the screen's own."""

    DEFAULT_CSS = "Newest > Line { min-height: 100%; }"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("pageup", "page_up", "Older lines", show=False),
        Binding("pagedown", "page_down", "Newer lines", show=False),
    ]

    def on_mount(self) -> None:
        """Stay at the end; draw the scrollbar, which textual moves undrawn."""
        self.anchor()
        laid_out = cast("Signal[object]", self.screen.screen_layout_refresh_signal)  # pyright: ignore[reportUnknownMemberType]
        laid_out.subscribe(self, lambda _: self.vertical_scrollbar.refresh())


class Rows(OptionList):
    """A list whose rows are literal text."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("enter", "select", "Open")]

    def __init__(self, place: str) -> None:
        super().__init__(id=place, markup=False)

    def fill(self, rows: Iterable[Content], at: int = 0) -> None:
        """Replace all rows, and put the cursor on one of them."""
        self.clear_options()
        self.add_options(Option(row) for row in rows)
        if self.option_count:
            self.highlighted = min(at, self.option_count - 1)


def plain(text: str) -> str:
    """Escape every character that a terminal acts on; a device's reply may hold an escape code."""
    return terminal.plain(text, keep="\n")


def one_line(text: str) -> str:
    """The same text on one line."""
    return plain(" ".join(text.split()))


def trouble(error: Exception | str) -> Content:
    """What went wrong, in the colour of errors."""
    return Content.styled(plain(str(error)), "bold $text-error")


def labelled(name: str, text: Content | str, columns: int = 10) -> Content:
    """A value after its name, which takes this many columns."""
    return Content.assemble((name.ljust(columns), "dim"), text)


def condition_text(condition: Condition) -> str:
    """`H 13 mm  α 5°`."""
    return f"H {condition.depth_mm:g} mm  α {condition.tilt_deg:g}°"


# Questions to the operator, with their answers on keys or typed; the stop keys work over all of them


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
    AskScreen #cause { height: 8; }
    AskScreen #live { height: auto; margin: 1 0; background: $boost; text-wrap: nowrap; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("q", "leave", "Leave: answer nothing, end the run"),
        Binding("escape", "dismiss", "Back"),
        HELP_KEY,
    ]

    def __init__(self, prompt: Prompt, answer: Callable[[str], object] | None = None) -> None:
        """`answer` passes a key on to the engine; without it the question is the screen's own."""
        super().__init__()
        self.prompt = prompt
        self._answer = answer
        self.own = answer is None
        """Whether the screen itself asks, not the engine."""
        self._live = Line("live")

    def compose(self) -> ComposeResult:
        """Lay out the question, its picture, and a line for each answer or for the one that is typed."""
        with Vertical():
            yield Static(question_content(self.prompt), id="question", markup=False)
            if self.prompt.image is not None:
                picture = picture_widget("cause")
                picture.show(self.prompt.image)
                yield picture
            if self.prompt.read is not None:
                yield Input(self.prompt.default, id="answer", compact=True)
            if not self.own:
                yield self._live
                yield Static("The arm does not move until this is answered.", markup=False)
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
