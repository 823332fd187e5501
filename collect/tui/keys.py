"""The keys of a run: the stop keys, the other keys, which of them do something in a state, and the text of the help.

`OperatorApp` passes each key to `is_stop_key` before any screen or field sees it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeGuard

from textual import events
from textual.binding import Binding

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.tui.text import SOFTWARE_STOP
from brushloop.collect.tui.widgets import Key

STOP_KEYS = frozenset({"s", "ctrl+c"})


def is_stop_key(event: events.Event) -> TypeGuard[events.Key]:
    """Whether this event is a key that stops the arm."""
    return isinstance(event, events.Key) and event.key in STOP_KEYS


@dataclass(frozen=True, slots=True)
class RunKey:
    """One key of a run, as the line of keys, the command palette and the help page show it."""

    key: str
    label: str
    what: str
    action: str = ""
    """Action of `OperatorApp`; empty where a screen or textual itself handles the key."""
    title: str = ""
    """Its name in the command palette; empty where it is not listed."""


RUN_KEYS = (
    RunKey("s", "STOP", "Stop the arm at once, on every screen and over every question", "stop", "Stop the arm now"),
    RunKey("space", "pause", "Pause before the next step, or go on", "pause", "Pause or go on"),
    RunKey("q", "leave", "Finish the step, park the arm, then leave", "quit", "Leave"),
    RunKey("?", "help", "This page", "help"),
    RunKey("tab", "pane", "On a narrow screen: overview, last capture, camera"),
    RunKey("enter", "large", "The last capture large; after a stop: resume the session", "enter", "Large, or resume"),
    RunKey("v", "review", "Look through the captures, mark and compare them", "review", "Review"),
    RunKey("r", "retake", "Press the current stroke again, once photographed", "request('RETAKE')", "Retake"),
    RunKey("k", "skip", "Skip the current stroke", "request('SKIP')", "Skip"),
    RunKey("n", "new sheet", "Put a new sheet in, before the next stroke", "request('NEW_SHEET')", "New sheet"),
    RunKey("j", "jog", "Find the paper again by jog, before the next stroke", "request('JOG')", "Jog"),
    RunKey("b", "bad", "Mark the last capture bad: pressed again at the end", "mark_last", "Last capture bad"),
    RunKey("ctrl-p", "commands", "All commands by name; dark, light, safe colours"),
)
"""Most important first: a narrow screen shows only as many as fit."""
RUN_BINDINGS: tuple[Binding, ...] = (
    # During a run, ctrl+c is a stop key and does not reach this binding.
    Binding("ctrl+c", "quit", "Leave", show=False, priority=True),
    Binding("p", "pause", "Pause or go on"),
    *(Binding("question_mark" if k.key == "?" else k.key, k.action, k.title or k.label) for k in RUN_KEYS if k.action),
)
CAN_GO_ON = frozenset({State.STOPPED, State.FAILED})
"""States in which a run has ended before its session was finished."""
CAN_PAUSE = frozenset({State.IDLE, State.RECOVERING, State.RUNNING})
CAN_RESUME = frozenset({State.PAUSING, State.PAUSED})
LABELS = {k.key: k.label for k in RUN_KEYS}
RUN_BAR: tuple[Key, ...] = tuple(LABELS.items())
OVER_BAR: tuple[Key, ...] = tuple((key, LABELS[key]) for key in ("q", "v", "?", "tab", "ctrl-p"))
GO_ON_BAR: tuple[Key, ...] = (("enter", "resume"), *OVER_BAR)


def keys_in(state: State, bar: tuple[Key, ...], *, resumable: bool = False) -> tuple[Key, ...]:
    """The keys of `bar` that do something in this state, each with what it does then."""
    if state in FINAL:
        return GO_ON_BAR if resumable and state in CAN_GO_ON else OVER_BAR
    space = "resume" if state in CAN_RESUME else "pause" if state in CAN_PAUSE else ""
    return tuple((key, space if key == "space" else label) for key, label in bar if key != "space" or space)


SIGNS = f"""\
{SOFTWARE_STOP}
r, k, n, j and b: press the key again to take it back.

Grid     ✓ complete   ▶ now   › next   ! had bad takes   × left out
Sheet    · blank   ● counts   ! does not count   × cut short   △ self-check

The same command resumes a session, after a crash or a lost terminal too:
no stroke twice, no cell of a sheet twice."""


def help_text() -> str:
    """Every key and sign of a run."""
    lines = [f"{'s, ctrl-c' if key.key == 's' else key.key:<11} {key.what}" for key in RUN_KEYS]
    return "\n".join([*lines, "", SIGNS])
