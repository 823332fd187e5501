"""The keys of a run: the stop keys, the other keys, which of them do something in a state, and the help page.

`OperatorApp` passes each key to `is_stop_key` before any screen or field sees it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

from collect.engine.control import FINAL, State
from collect.tui.text import SOFTWARE_STOP
from collect.tui.widgets import Key

STOP_KEYS = frozenset({"s", "ctrl+c"})
STOP_LABEL: Key = ("s", "STOP")


def is_stop_key(event: events.Event) -> bool:
    """Whether this event is a key that stops the arm."""
    return isinstance(event, events.Key) and event.key in STOP_KEYS


@dataclass(frozen=True, slots=True)
class RunKey:
    """One key of a run, as the line of keys and the command palette show it."""

    key: str
    label: str
    action: str = ""
    """Action of `OperatorApp`; empty where a screen or textual itself handles the key."""
    title: str = ""
    """Its name in the command palette; empty where it is not listed."""
    what: str = ""


RUN_KEYS = (
    RunKey("s", "STOP", "stop", "Stop the arm now", "A software stop; the red button is the emergency stop"),
    RunKey("space", "pause", "pause", "Pause or go on", "Before the next step"),
    RunKey("q", "leave", "quit", "Leave", "Finish the step, park, leave"),
    RunKey("?", "help", "help"),
    RunKey("tab", "pane"),
    RunKey("v", "review", "review", "Review", "Look through the captures"),
    RunKey("r", "retake", "request('RETAKE')", "Retake", "Press the stroke in hand again"),
    RunKey("k", "skip", "request('SKIP')", "Skip", "Leave the stroke in hand out"),
    RunKey("n", "new sheet", "request('NEW_SHEET')", "New sheet", "Put a new sheet in before the next stroke"),
    RunKey("j", "jog", "request('JOG')", "Jog", "Find the paper again by jog before the next stroke"),
    RunKey("b", "bad", "mark_last", "Last capture bad", "It does not count, and is pressed again at the end"),
    RunKey("ctrl-p", "commands"),
)
"""The most needed first: a narrow screen shows only as many as fit."""
RUN_BINDINGS: tuple[Binding, ...] = (
    # With a run on, ctrl+c is a stop key and does not come this far.
    Binding("ctrl+c", "quit", "Leave", show=False, priority=True),
    Binding("p", "pause", "Pause or go on"),
    *(Binding("question_mark" if k.key == "?" else k.key, k.action, k.title or k.label) for k in RUN_KEYS if k.action),
)
CAN_PAUSE = frozenset({State.IDLE, State.RECOVERING, State.RUNNING})
CAN_RESUME = frozenset({State.PAUSING, State.PAUSED})
RUN_BAR: tuple[Key, ...] = tuple((k.key, k.label) for k in RUN_KEYS)
SET_UP_BAR: tuple[Key, ...] = (
    STOP_LABEL,
    ("space", "pause"),
    ("q", "leave"),
    ("?", "help"),
    ("ctrl-p", "commands"),
    ("tab", "camera"),
)
OVER_BAR: tuple[Key, ...] = (("q", "leave"), ("v", "review"), ("?", "help"), ("tab", "pane"), ("ctrl-p", "commands"))


def keys_in(state: State, bar: tuple[Key, ...]) -> tuple[Key, ...]:
    """The keys of `bar` that do something in this state, each with what it does then."""
    if state in FINAL:
        return OVER_BAR
    space = "resume" if state in CAN_RESUME else "pause" if state in CAN_PAUSE else ""
    return tuple((key, space if key == "space" else label) for key, label in bar if key != "space" or space)


HELP = f"""\
s, ctrl-c   STOP the arm now, on every screen and over every question
            {SOFTWARE_STOP}
space       pause before the next step, and go on
q           leave: finishes the step, parks the arm, then leaves
r           retake: press the stroke in hand again, once photographed
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
    """Every key and sign on one page; any of its own keys closes it."""

    DEFAULT_CSS = """
    HelpScreen { align: center middle; }
    HelpScreen VerticalScroll {
        width: 80; max-width: 100%; height: auto; max-height: 100%; padding: 0 1;
        border: heavy $accent; background: $surface;
    }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,question_mark,enter", "close", "Close")]

    def compose(self) -> ComposeResult:
        """Lay out the page."""
        with VerticalScroll() as page:
            page.border_title = "Help, escape closes"
            yield Static(HELP, markup=False)

    def action_close(self) -> None:
        """Close the page."""
        self.dismiss(None)
