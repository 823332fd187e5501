"""The operator's app: shows the engine's snapshot ten times a second; its keys send the engine requests."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import ClassVar

from textual import events, work
from textual.app import SystemCommand
from textual.binding import BindingType
from textual.screen import Screen

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.errors import NOT_AT_REST, ConfigError
from brushloop.collect.headless import REFRESH_S, RunnableEngine
from brushloop.collect.operator import OperatorRequest
from brushloop.collect.tui.browser import SessionBrowser
from brushloop.collect.tui.keys import CAN_GO_ON, CAN_PAUSE, CAN_RESUME, RUN_BINDINGS, RUN_KEYS, help_text, is_stop_key
from brushloop.collect.tui.panes import live_content
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.question_screens import AT_WORK, NOT_PARKED, UNSEEN, AskScreen, Confirm
from brushloop.collect.tui.run_screen import RunScreen
from brushloop.collect.tui.start_screen import StartScreen
from brushloop.collect.tui.terminal import PlainApp
from brushloop.collect.tui.text import plain
from brushloop.collect.tui.widgets import HelpScreen
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import mark_bad_or_good

BOUNCE_S = 0.7
"""Time after an answer in which the keys of requests do nothing: pressing an answer's key twice sends no request."""


class OperatorApp(PlainApp):
    """The operator's app: for a whole day with a browser, for one run with an engine."""

    TITLE = "brushloop"
    # A selection would be copied with ctrl+c, which is a stop key here.
    ALLOW_SELECT = False
    BINDINGS: ClassVar[list[BindingType]] = [*RUN_BINDINGS]

    def __init__(
        self,
        engine: RunnableEngine | None = None,
        *,
        browser: SessionBrowser | None = None,
        again: Callable[[str], RunnableEngine] | None = None,
        pictures: Pictures | None = None,
        theme_file: Path | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """With an engine, show that run; with a browser, the start screen first.

        `again` makes the engine that resumes a session after a stop. `theme_file` keeps the colours for
        the next start. `now_s` is the clock of ages.
        """
        super().__init__(theme_file)
        self.engine: RunnableEngine | None = engine
        self._again: Callable[[str], RunnableEngine] | None = again
        self._pictures = pictures or Pictures()
        self._now: Snapshot | None = None if engine is None else engine.snapshot()
        self._main: RunScreen | None = None
        self._browser = browser
        self._now_s = now_s
        self._leave = threading.Event()
        self._leave_when_over = False
        self._deaf_until_s = 0.0

    def on_mount(self) -> None:
        """Show the first screen; then poll the engine at 10 Hz."""
        if self._browser is not None:
            self._again = partial(self._browser.engine, preview=self._pictures.camera_shown)
            begin = partial(partial, self._browser.engine, preview=self._pictures.camera_shown)
            self.push_screen(
                StartScreen(
                    self._browser,
                    lambda session_id: self._begin(begin(session_id)),
                    self._review_named,
                    now_s=self._now_s,
                )
            )
        if self.engine is not None:
            self._show_run()
        self.call_after_refresh(self._poll)
        self.set_interval(REFRESH_S, self._poll)

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

    @property
    def leaving(self) -> bool:
        """True once `leave` was called."""
        return self._leave.is_set()

    def leave(self) -> None:
        """End the app soon, whatever the state; from any thread."""
        self._leave.set()

    def action_request(self, name: str) -> None:
        """Send the engine a request, or withdraw it."""
        if self.engine is not None and self._now_s() >= self._deaf_until_s:
            self.engine.request(OperatorRequest[name])
            self._poll()

    def action_enter(self) -> None:
        """Resume the session of a run that ended before its time: the engine asks first; else show the last capture."""
        if self._now is None or self.screen is not self._main:
            return
        if self._can_go_on and self._again is not None:
            self._begin(partial(self._again, Path(self._now.folder).name))
        else:
            self.action_enlarge()

    async def action_quit(self) -> None:
        """Leave; ask first if the arm is not parked."""
        if isinstance(self.screen, Confirm):
            return
        now = self._now
        if now is None:
            self.exit()
        elif now.state is State.STOPPING:
            self.notify("The arm is being stopped. Press the red button if it keeps moving.", severity="warning")
        elif now.rest_unknown:
            self.push_screen(Confirm(*UNSEEN), self._leave_answered)
        elif now.state not in FINAL:
            self.push_screen(Confirm(*AT_WORK), self._park_answered)
        elif now.parked or now.target_mm is None:
            self._away()
        else:
            self.push_screen(Confirm(*NOT_PARKED), self._leave_answered)

    def _park_answered(self, yes: bool | None) -> None:
        if yes and self.engine is not None:
            self._leave_when_over = True
            self.engine.park()

    def _leave_answered(self, yes: bool | None) -> None:
        if yes:
            self._away()

    def _away(self) -> None:
        """Go back to the start screen if there is one, else end the app."""
        if self._browser is None:
            self.exit()
            return
        while len(self.screen_stack) > 2:
            self.pop_screen()
        if self._now is not None and self._now.rest_unknown and isinstance(self.screen, StartScreen):
            self.screen.show_trouble(NOT_AT_REST)
        self._main = self._now = None
        self._leave_when_over = False

    @work(exclusive=True, group="begin")
    async def _begin(self, make: Callable[[], RunnableEngine]) -> None:
        """Wait for the end of the run before; read and check the files off the screen's loop; start the run."""
        try:
            engine = await asyncio.to_thread(_after, self.engine, make)
        except (ConfigError, SessionError, OSError) as error:
            if isinstance(self.screen, StartScreen):
                self.screen.show_trouble(str(error))
            else:
                self.notify(plain(str(error)), severity="error", timeout=20)
            return
        if self.leaving:
            return  # a signal came meanwhile: nobody would watch this run
        self.engine = engine
        self._leave_when_over = False
        engine.start()
        self._now = engine.snapshot()
        self._show_run()

    def _review_named(self, session_id: str) -> None:
        assert self._browser is not None
        self._review(self._browser.paths.root / session_id)

    def _show_run(self) -> None:
        """Show the run screen."""
        if self._main is None:
            self._main = RunScreen(self._pictures, resumable=self._again is not None, now_s=self._now_s)
            self.push_screen(self._main)

    def _poll(self) -> None:
        if not self.is_running:
            return  # the timer may tick once more while the app closes, when it has no screens left
        if self.leaving:
            self.exit()
        if self.engine is None or self._now is None:
            return
        before, self._now = self._now, self.engine.snapshot()
        if self._main is not None and self._main.is_mounted:
            self._main.show(self._now)
        self._ask(self._now)
        if self._now.state is not before.state:
            self.refresh_bindings()
            if self._now.state in FINAL | {State.STOPPING} and isinstance(self.screen, Confirm):
                self.pop_screen()  # what it asks about is over
            if self._now.state is State.DONE and self._again is not None:
                self._show_end(self._now)
        if self._leave_when_over and self._now.state in FINAL:
            if self._now.rest_unknown:
                self._leave_when_over = False  # the operator has to read that first
            else:
                self._away()

    def _show_end(self, now: Snapshot) -> None:
        """Show the card of a finished session, unless the operator is looking at something else."""
        if now.folder and self.screen is self._main and not self._leave_when_over:
            from brushloop.collect.tui.end_screen import EndScreen

            self.push_screen(EndScreen(now, self._pictures), self._end_answered)

    def _end_answered(self, answer: str | None) -> None:
        if answer == "review":
            self.call_after_refresh(self.action_review)
        elif answer == "finish" and self._now is not None:
            from brushloop.collect.tui.finish_screen import FinishScreen

            self.push_screen(FinishScreen(Path(self._now.folder), is_open=False))

    def _ask(self, now: Snapshot) -> None:
        prompt = now.prompt
        shown = next((screen for screen in self.screen_stack if isinstance(screen, AskScreen)), None)
        if shown is not None and prompt is not None and shown.prompt.number == prompt.number:
            shown.show(live_content(now))
            return
        if shown is not None and shown is self.screen:
            self.pop_screen()
            self._deaf_until_s = self._now_s() + BOUNCE_S
        if prompt is not None and self.engine is not None and not isinstance(self.screen, Confirm | AskScreen):
            self.push_screen(AskScreen(prompt, self.engine, self._pictures))


def _after(before: RunnableEngine | None, make: Callable[[], RunnableEngine]) -> RunnableEngine:
    """Make an engine once the one before has let go of session and devices; how that one ended was shown."""
    if before is not None:
        with contextlib.suppress(Exception):
            before.join()
    return make()
