"""Every key and sign on one page."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

from collect.tui.text import SOFTWARE_STOP

HELP = f"""\
s, ctrl-c   STOP the arm now, on every screen and over every question
            {SOFTWARE_STOP}
space       pause before the next step, and go on
q           leave: finishes the step, parks the arm, then leaves
r           press the stroke in hand again, once it is photographed
b           the last capture is bad: pressed again once the plan is through
k           leave the stroke in hand out
n           put a new sheet in, before the next stroke
j           find the paper again by jog, before the next stroke
            (r, b, k, n, j: the same key again takes it back)
v           look through the captures: mark, note, how alike they are
tab         on a narrow screen: overview, last capture, camera
ctrl-p, ?   all commands by name, light and dark among them; this page

Grid     ✓ complete   ▶ now   › next   ! had bad takes   × left out
Sheet    · blank   ● counts   ! does not count   × burnt   △ self-check

The same command resumes a session, after a crash or a lost terminal too:
no stroke twice, no cell of a sheet twice."""


class HelpScreen(ModalScreen[None]):
    """The page; any of its keys closes it."""

    DEFAULT_CSS = """
    HelpScreen { align: center middle; }
    HelpScreen VerticalScroll {
        width: 80; max-width: 100%; height: auto; max-height: 100%; padding: 0 1;
        border: heavy $accent; background: $surface;
    }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,question_mark,enter", "close", "Close")]

    def compose(self) -> ComposeResult:
        """The page."""
        with VerticalScroll() as page:
            page.border_title = "Help, escape closes"
            yield Static(HELP, markup=False)

    def action_close(self) -> None:
        """Away with it."""
        self.dismiss(None)
