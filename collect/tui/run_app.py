"""An app with a run: its keys, which send requests to the engine or show what the run has captured."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import ClassVar

from textual import events
from textual.app import SystemCommand
from textual.binding import BindingType
from textual.screen import Screen

from brushloop.collect.engine.control import FINAL
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.headless import RunnableEngine
from brushloop.collect.tui.keys import CAN_GO_ON, CAN_PAUSE, CAN_RESUME, RUN_BINDINGS, RUN_KEYS, help_text, is_stop_key
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.collect.tui.terminal import PlainApp
from brushloop.collect.tui.text import plain
from brushloop.collect.tui.widgets import HelpScreen
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import mark_bad_or_good


class RunApp(PlainApp):
    """What the keys of a run do; which screen is shown is up to `OperatorApp`."""

    # A selection would be copied with ctrl+c, which is a stop key here.
    ALLOW_SELECT = False
    BINDINGS: ClassVar[list[BindingType]] = [*RUN_BINDINGS]

    def __init__(
        self,
        engine: RunnableEngine | None,
        again: Callable[[str], RunnableEngine] | None,
        pictures: Pictures,
        theme_file: Path | None,
    ) -> None:
        """`again` makes the engine that resumes a session after a stop; `theme_file` keeps the colours."""
        super().__init__(theme_file)
        self.engine: RunnableEngine | None = engine
        self._again: Callable[[str], RunnableEngine] | None = again
        self._pictures = pictures
        self._now: Snapshot | None = None if engine is None else engine.snapshot()
        self._main: RunScreen | None = None

    @property
    def at_work(self) -> bool:
        """Whether a run is in progress."""
        return self._now is not None and self._now.state not in FINAL

    async def on_event(self, event: events.Event) -> None:
        """Handle stop keys before textual, which would give a letter to a field that takes text, as in the palette."""
        if is_stop_key(event) and self.at_work:
            self.action_stop()
            return
        await super().on_event(event)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Disable the keys of a run if there is no run."""
        if action == "stop":
            return self.at_work
        if action == "pause":
            return self._now is not None and self._now.state in CAN_PAUSE | CAN_RESUME
        if action in ("request", "mark_last"):
            return self.at_work
        if action == "enter":
            return self._can_go_on or (self._now is not None and self._now.last is not None)
        if action == "review":
            return self._now is not None and bool(self._now.folder)
        return super().check_action(action, parameters)

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """List the keys of a run by name, then the colours."""
        for key in RUN_KEYS:
            if key.title and self.check_action(key.action.partition("(")[0], ()):
                run = partial(self.call_later, self.run_action, key.action)
                yield SystemCommand(key.title, key.what, run)
        yield from super().get_system_commands(screen)

    def action_stop(self) -> None:
        """Stop the arm at once and show that, even if another screen covers the run."""
        if self.engine is not None:
            self.engine.stop()
            if self._main is not None and self._main.is_mounted:
                self._main.stop_sent()
            if self.screen is not self._main:
                self.notify("STOP SENT", severity="warning", timeout=2)

    def action_pause(self) -> None:
        """Pause before the next step, or go on."""
        if self.engine is not None and self._now is not None:
            (self.engine.resume if self._now.state in CAN_RESUME else self.engine.pause)()

    def action_mark_last(self) -> None:
        """Mark the newest capture bad, or good again; the mark is on disk at once."""
        last = None if self._now is None else self._now.last
        if self._now is None or last is None or not last.kept or self.screen is not self._main:
            return
        try:
            bad = mark_bad_or_good(Path(self._now.folder), last.still, last.press.stroke_id, time.time_ns())
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        mark = "marked bad: pressed again after the planned strokes" if bad else "marked good again"
        self.notify(f"{last.press.stroke_id}: {mark}")

    def action_help(self) -> None:
        """Show every key."""
        if not isinstance(self.screen, HelpScreen):
            self.push_screen(HelpScreen(help_text()))

    def action_review(self) -> None:
        """Look through the captures of the run that is shown."""
        if self._now is not None and self._now.folder and self.screen is self._main:
            self._review(Path(self._now.folder))

    def action_enlarge(self) -> None:
        """Show the last capture large."""
        if self._now is not None and self._now.last is not None and self.screen is self._main:
            from brushloop.collect.tui.capture_screen import CaptureScreen
            from brushloop.collect.tui.large import of_last

            self.push_screen(CaptureScreen(of_last(self._now.last), self._pictures, at_work=self.at_work))

    def _review(self, folder: Path) -> None:
        from brushloop.collect.tui.captures import Review
        from brushloop.collect.tui.review_screen import ReviewScreen

        try:
            review = Review(folder)
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        self.push_screen(ReviewScreen(review, self._pictures, at_work=lambda: self.at_work))

    @property
    def _can_go_on(self) -> bool:
        now = self._now
        return self._again is not None and now is not None and now.state in CAN_GO_ON and bool(now.folder)
