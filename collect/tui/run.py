"""The run screen: the view, and its keys."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.screen import Screen

from collect.engine.snapshot import Snapshot
from collect.tui.keys import RUN_KEYS, KeyBar, keys_in
from collect.tui.pictures import Pictures
from collect.tui.view import RunView


class RunScreen(Screen[None]):
    """One run, from its first retreat to its end."""

    AUTO_FOCUS = "#log-pane"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("tab", "next_pane", "Next pane")]

    def __init__(self, pictures: Pictures) -> None:
        super().__init__()
        self._view = RunView(pictures)
        self._keys = KeyBar(RUN_KEYS)

    def compose(self) -> ComposeResult:
        """The view and the keys."""
        yield self._view
        yield self._keys

    def action_next_pane(self) -> None:
        """On a narrow screen, the next pane."""
        self._view.next_pane()

    def stop_sent(self) -> None:
        """Show at once that the stop key was heard."""
        self._view.stop_sent()

    def show(self, now: Snapshot) -> None:
        """Draw what differs."""
        self._view.show(now)
        self._keys.show(keys_in(now.state, RUN_KEYS))
