"""The keys at the bottom of every screen: as many as fit, the way out and the stop first."""

from __future__ import annotations

from collections.abc import Sequence

from rich.cells import cell_len
from textual.app import RenderResult
from textual.content import Content
from textual.widget import Widget

from collect.engine.states import FINAL, State

Key = tuple[str, str]
"""The key and what it does."""
GAP = 2
STOP_KEY: Key = ("s", "STOP")
RUN_KEYS: tuple[Key, ...] = (
    STOP_KEY,
    ("space", "pause"),
    ("q", "leave"),
    ("?", "help"),
    ("tab", "pane"),
    ("v", "review"),
    ("r", "retake"),
    ("k", "skip"),
    ("n", "new sheet"),
    ("j", "jog"),
    ("b", "bad"),
    ("ctrl-p", "commands"),
)


CAN_PAUSE = frozenset({State.IDLE, State.RECOVERING, State.RUNNING})
CAN_RESUME = frozenset({State.PAUSING, State.PAUSED})
OVER_KEYS: tuple[Key, ...] = (("q", "leave"), ("v", "review"), ("?", "help"), ("tab", "pane"), ("ctrl-p", "commands"))


def keys_in(state: State, keys: Sequence[Key]) -> tuple[Key, ...]:
    """Those keys of a run that do something in this state, called by what they do."""
    if state in FINAL:
        return OVER_KEYS
    space = "resume" if state in CAN_RESUME else "pause" if state in CAN_PAUSE else ""
    return tuple((key, space if key == "space" else what) for key, what in keys if key != "space" or space)


class KeyBar(Widget):
    """One line of keys."""

    DEFAULT_CSS = """
    KeyBar { dock: bottom; height: 1; background: $panel; color: $foreground; text-wrap: nowrap; padding: 0 1; }
    """

    def __init__(self, keys: Sequence[Key] = ()) -> None:
        super().__init__()
        self._keys = tuple(keys)

    def show(self, keys: Sequence[Key]) -> None:
        """Other keys, if they are others."""
        if tuple(keys) != self._keys:
            self._keys = tuple(keys)
            self.refresh()

    def render(self) -> RenderResult:
        """The keys that fit, in order of need."""
        return keys_content(self._keys, self.size.width)


def keys_content(keys: Sequence[Key], room: int) -> Content:
    """`s STOP  space pause  q leave ...` as far as it fits."""
    parts: list[Content] = []
    used = 0
    for key, what in keys:
        width = cell_len(key) + 1 + cell_len(what)
        if used + width > room:
            break
        parts.append(Content.assemble((key, "bold $text-accent"), f" {what}"))
        used += width + GAP
    return Content(" " * GAP).join(parts)
