"""The large view of one capture: a picture as large as the terminal, and its checks, the missed ones first."""

from __future__ import annotations

from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.screen import Screen

from brushloop.collect.tui.large import BOTH, CAPTURED, PREDICTED, LargeCapture, limit_text, number_text
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.text import one_line, plain
from brushloop.collect.tui.widgets import KeyBar, Line, app_of

KEYS = (("escape", "back"), ("→", "next picture"), ("1-4", "picture"))
KEYS_AT_WORK = (("s", "STOP"), *KEYS)
TWO_COLUMNS = 150
"""Width from which the photograph is shown beside the other pictures."""
NAME, VALUE = 10, 6
"""Columns of a check's name and value: with its limit and unit they fit beside the picture."""


class CaptureScreen(Screen[None]):
    """One capture; arrows and digits choose the picture."""

    AUTO_FOCUS = None
    DEFAULT_CSS = """
    CaptureScreen #large-title { height: 1; padding: 0 1; background: $panel; text-style: bold; }
    CaptureScreen #large-body { height: 1fr; }
    CaptureScreen #large-pictures { width: 1fr; padding: 0 1; }
    CaptureScreen #large-names { height: 1; text-wrap: nowrap; }
    CaptureScreen #large-photo { display: none; margin-right: 1; }
    CaptureScreen.-two #large-photo { display: block; }
    CaptureScreen #large-side { width: 36; padding: 0 1; border-left: solid $foreground 40%; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,enter,q", "back", "Back"),
        Binding("right,tab", "turn(1)", "Next picture"),
        Binding("left,shift+tab", "turn(-1)", "Picture before"),
        *(Binding(str(number), f"choose({number - 1})", "Picture", show=False) for number in range(1, 5)),
    ]

    def __init__(self, capture: LargeCapture, pictures: Pictures, *, at_work: bool) -> None:
        """`at_work`: whether a run is on, which `s` stops."""
        super().__init__()
        self._capture = capture
        self._images = capture.pictures()
        self._at = len(self._images) - 1
        self._names = Line("large-names")
        self._photo, self._picture = pictures.make("large-photo"), pictures.make("large-picture")
        self._keys = KeyBar(KEYS_AT_WORK if at_work else KEYS)

    def compose(self) -> ComposeResult:
        """Lay out the pictures beside the checks."""
        title = Line("large-title")
        title.show(one_line(self._capture.title))
        yield title
        with Horizontal(id="large-body"):
            with Vertical(id="large-pictures"):
                yield self._names
                with Horizontal():
                    yield self._photo
                    yield self._picture
            with VerticalScroll(id="large-side") as side:
                side.can_focus = False
                words = Line("large-words")
                words.show(words_content(self._capture))
                yield words
        yield self._keys

    def on_mount(self) -> None:
        """Show the last picture, which says most."""
        self._photo.show(self._capture.photo)
        self._show()

    def on_resize(self, event: events.Resize) -> None:
        """Show the photograph beside the picture where there is room."""
        self.set_class(event.size.width >= TWO_COLUMNS, "-two")

    def action_back(self) -> None:
        """Go back."""
        app_of(self).pop_screen()

    def action_turn(self, by: int) -> None:
        """Show the next picture, or the one before."""
        if self._images:
            self.action_choose((self._at + by) % len(self._images))

    def action_choose(self, at: int) -> None:
        """Show the picture of this number, if there is one."""
        if at < len(self._images):
            self._at = at
            self._show()

    def _show(self) -> None:
        if not self._images:
            self._names.show("no picture: the board is not seen in this photograph")
            return
        names = list(self._images)
        self._names.show(
            Content("  ").join(
                Content.styled(f" {number} {name} ", "bold reverse" if number == self._at + 1 else "dim")
                for number, name in enumerate(names, 1)
            )
        )
        self._picture.show(self._images[names[self._at]])


def words_content(capture: LargeCapture) -> Content:
    """The checks with value and limit, those missed first with what to do; then what is compared."""
    lines: list[Content] = []
    missed = [check for check in capture.checks if not check.passed]
    for check in missed:
        lines.append(_row("!", check.name, number_text(check.score), limit_text(check), "bold $text-warning"))
        lines.append(Content(plain(check.reason)))
    if missed:
        lines.append(Content(""))
    for check in capture.checks:
        if check.passed:
            lines.append(_row("✓", check.name, number_text(check.score), limit_text(check), ""))
    if not capture.checks:
        lines.append(Content.styled("not judged", "dim"))
    lines += [Content(""), Content.styled(plain(capture.model), "bold")]
    if capture.csim is not None:
        lines.append(Content(f"CSIM {100.0 * capture.csim:.1f} % in mm"))
    if capture.predicted is not None and capture.binary is not None:
        for colour, what in ((BOTH, "both"), (CAPTURED, "captured only"), (PREDICTED, "predicted only")):
            lines.append(Content.assemble(("██", "rgb({},{},{})".format(*colour)), f" {what}"))
    return Content("\n").join(lines)


def _row(sign: str, name: str, value: str, limit: str, style: str) -> Content:
    return Content.assemble((f"{sign} {name:<{NAME}}{value:>{VALUE}}", style), (f"  {limit}", "dim"))
