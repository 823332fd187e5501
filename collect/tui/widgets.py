"""What several screens use: literal text that is drawn only when it changed, and values in words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar, cast

from textual.app import App
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.dom import DOMNode
from textual.widget import Widget
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from brushloop.sessions import terminal

if TYPE_CHECKING:
    from brushloop.sessions.records import Condition

SOFTWARE_STOP = "s is a software stop. The red button is the emergency stop."
SHORT_STOP = "s: software stop; red button: emergency stop"
STOP = Binding("s", "app.stop", "STOP", tooltip="Stop the arm at once, on every screen and over every question")
"""Shown first on every screen while the arm may move. The app takes this key and ctrl-c before any screen sees them."""
HELP_KEY = Binding("question_mark", "app.help", "Help", key_display="?", tooltip="Every key of this screen, on and off")


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


def entitle(widget: Widget, title: str) -> None:
    """Set the title in a widget's border, if it is new: textual draws the whole widget again."""
    if widget.border_title != title:
        widget.border_title = title


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


def tip_text(tip_mm: tuple[float, float, float] | None) -> str:
    """The tip's position, or `no pose`."""
    if tip_mm is None:
        return "no pose"
    x, y, z = tip_mm
    return f"x {x:7.2f}  y {y:7.2f}  z {z:7.2f} mm"
