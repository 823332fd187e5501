"""The operator's app: shows the engine's snapshot ten times a second; its keys send the engine requests.

However it ends, by a signal, a lost terminal or a crash, no arm is left unwatched.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.binding import Binding, BindingType

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.snapshot import REFRESH_S, Snapshot
from brushloop.collect.errors import NOT_AT_REST, CollectAborted, ConfigError
from brushloop.collect.operator import Choice, Prompt, stop_signals
from brushloop.collect.tui.pictures import look_for_pixels
from brushloop.collect.tui.run_screen import RunScreen, live_content
from brushloop.collect.tui.start_screen import SessionBrowser, StartScreen
from brushloop.collect.tui.terminal import PlainApp
from brushloop.collect.tui.widgets import HELP_KEY, YES, AskScreen, plain, yes_or_no
from brushloop.sessions.errors import SessionError

if TYPE_CHECKING:
    from brushloop.collect.engine.engine import Engine

LEAVE = yes_or_no(
    "A run is in progress. Finish its step, park the arm, and leave?", "park the arm and leave", "let the run continue"
)
NOT_PARKED = yes_or_no(
    "The arm is not parked: it rests where it was stopped, perhaps with the brush down. "
    "The next run begins by lifting the brush. Quit all the same?",
    "quit, and leave the arm where it is",
    "back to this screen",
)
UNSEEN = yes_or_no(f"{NOT_AT_REST} Quit all the same?", "quit, and leave the arm where it is", "back to this screen")
NO_RUN = Snapshot(state=State.DONE)
"""What is shown before the first run of a day and between two of them."""
LOOK, BACK = Choice("v", "look through the captures"), Choice("q", "back to the run")
GO_ON = Choice("g", "go on: leave this screen; the command continues")
ANALYSE = Choice("a", "analyse: calibrate, fit the brush, compare the models, and write the report")


class OperatorApp(PlainApp):
    """The operator's app: for a whole day with a browser, for one run with an engine."""

    BINDINGS: ClassVar[list[BindingType]] = [
        # During a run, ctrl+c is a stop key and does not reach this binding.
        Binding("ctrl+c", "quit", "Leave", show=False, priority=True),
        Binding("q", "quit", "Leave"),
        HELP_KEY,
    ]

    def __init__(
        self, again: Callable[[str], Engine], engine: Engine | None = None, *, browser: SessionBrowser | None = None
    ) -> None:
        """With an engine, show that run; with a browser, the start screen first.

        `again` makes the engine that resumes a session after a stop.
        """
        super().__init__()
        self.engine = engine
        self.leaving = False
        """Whether the app is to end soon, whatever the state; may be set by any thread."""
        self.next = ANALYSE
        """What is offered after a finished run."""
        self._browser = browser
        self._again = again
        self._now = NO_RUN if engine is None else engine.snapshot()
        self._main: RunScreen | None = None
        self._leave_when_over = False

    def on_mount(self) -> None:
        """Show the first screen; then poll the engine at 10 Hz."""
        if self._browser is not None:
            self.push_screen(StartScreen(self._browser, self.begin, self.review, self.run_command))
        if self.engine is not None:
            self._show_run(self.engine)
        self.call_after_refresh(self._poll)
        self.set_interval(REFRESH_S, self._poll)

    @property
    def at_work(self) -> bool:
        """Whether a run is in progress."""
        return self._now.state not in FINAL

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Disable the keys that would do nothing now."""
        match action:
            case "stop":
                return self.at_work
            case "begin_again":
                return self._now.state in (State.STOPPED, State.FAILED) and bool(self._now.folder)
            case "review":
                return bool(self._now.folder)
            case _:
                return super().check_action(action, parameters)

    def action_stop(self) -> None:
        """Stop the arm at once and show that, whichever screen covers the run."""
        if self.engine is not None:
            self.engine.stop()
            super().action_stop()

    def action_review(self) -> None:
        """Look through the captures of the run that is shown."""
        self.review(Path(self._now.folder))

    def review(self, folder: Path) -> None:
        """Look through the captures of a session."""
        from brushloop.collect.tui.review_screen import Review, ReviewScreen  # slow to import

        try:
            self.push_screen(ReviewScreen(Review(folder), lambda: self.at_work))
        except SessionError as error:
            self._complain(error)

    def _complain(self, error: Exception) -> None:
        self.notify(plain(str(error)), severity="error", timeout=20)

    def action_begin_again(self) -> None:
        """Resume the session of a run that ended before its time: the engine asks first."""
        self.begin(partial(self._again, Path(self._now.folder).name))

    async def action_quit(self) -> None:
        """Leave; ask first if the arm is not parked."""
        now = self._now
        if isinstance(self.screen, AskScreen) and self.screen.own:
            return
        if self._main is None:
            self.exit()
        elif now.state is State.STOPPING:
            self.notify("The arm is being stopped. Press the red button if it keeps moving.", severity="warning")
        elif now.rest_unknown:
            self._confirm(UNSEEN, self._away)
        elif now.state not in FINAL:
            self._confirm(LEAVE, self._park_and_leave)
        elif now.parked or now.target_mm is None:
            self._away()
        else:
            self._confirm(NOT_PARKED, self._away)

    def _confirm(self, question: Prompt, do: Callable[[], None]) -> None:
        self.push_screen(AskScreen(question), lambda key: do() if key == YES else None)

    def _park_and_leave(self) -> None:
        if self.engine is not None:
            self._leave_when_over = True
            self.engine.park()

    def _away(self) -> None:
        """Go back to the start screen if there is one, else end the app."""
        if self._browser is None:
            self.exit()
            return
        while len(self.screen_stack) > 2:
            self.pop_screen()
        if self._now.rest_unknown and isinstance(self.screen, StartScreen):
            self.screen.show_trouble(NOT_AT_REST)
        self._main, self._now = None, NO_RUN
        self._leave_when_over = False

    @work(exclusive=True, group="begin")
    async def begin(self, make: Callable[[], Engine]) -> None:
        """Wait for the end of the run before; read and check the files off the screen's loop; start the run."""
        before = self.engine

        def prepare() -> Engine:
            if before is not None:
                # Session and devices must be free; how that run ended was shown.
                with contextlib.suppress(Exception):
                    before.join()
            return make()

        try:
            engine = await asyncio.to_thread(prepare)
        except (ConfigError, SessionError, OSError) as error:
            if isinstance(self.screen, StartScreen):
                self.screen.show_trouble(str(error))
            else:
                self._complain(error)
            return
        if self.leaving:
            return  # a signal came meanwhile: nobody would watch this run
        self.engine = engine
        self._leave_when_over = False
        engine.start()
        self._now = engine.snapshot()
        self._show_run(engine)

    def _show_run(self, engine: Engine) -> None:
        if self._main is None:
            self._main = RunScreen(engine)
            self.push_screen(self._main)
        self._main.engine = engine

    def _poll(self) -> None:
        if not self.is_running:
            return  # the timer may tick once more while the app closes, when it has no screens left
        if self.leaving:
            self.exit()
        if self.engine is None or self._main is None:
            return
        before, self._now = self._now, self.engine.snapshot()
        if self._main.is_mounted:
            self._main.show(self._now)
        self._ask(self.engine, self._main, self._now)
        if self._now.state is not before.state:
            over = self._now.state in FINAL | {State.STOPPING}
            if over and isinstance(self.screen, AskScreen) and self.screen.own:
                self.pop_screen()  # what it asks about is over
            busy = self.screen is not self._main or self._leave_when_over
            if self._now.state in FINAL:
                self.bell()
                self.clear_notifications()  # that a stop was sent would cover why the run ended
            if self._now.state is State.DONE and self._now.folder and not busy:
                self._offer_analysis(Path(self._now.folder))
        if self._leave_when_over and self._now.state in FINAL:
            if self._now.rest_unknown:
                self._leave_when_over = False  # the operator has to read that first
            else:
                self._away()

    def _offer_analysis(self, folder: Path) -> None:
        """Offer what comes after a finished run."""

        def answered(key: str | None) -> None:
            if key == ANALYSE.key:
                self.run_command("analyse", str(folder))
                self._offer_analysis(folder)
            elif key == LOOK.key:
                self.call_after_refresh(self.action_review)
            elif key == GO_ON.key:
                self.call_after_refresh(self.action_quit)

        question = Prompt(f"What shall be done next with {folder}?", (LOOK, self.next, BACK), BACK.key)
        self.push_screen(AskScreen(question), answered)

    def _ask(self, engine: Engine, run: RunScreen, now: Snapshot) -> None:
        """Show the engine's question, and take it away once it is answered."""
        prompt = now.prompt
        shown = next((screen for screen in self.screen_stack if isinstance(screen, AskScreen) and not screen.own), None)
        if shown is not None and prompt is not None and shown.prompt.number == prompt.number:
            shown.show(live_content(now))
            return
        if shown is not None and shown is self.screen:
            self.pop_screen()
            run.answered()
        if prompt is not None and not isinstance(self.screen, AskScreen):
            self.bell()  # nobody looks at the screen all the time
            self.push_screen(AskScreen(prompt, partial(engine.answer, prompt.number)))


class ScreenCrashed(Exception):
    """The screen crashed and has printed the error; the arm was stopped."""


def run_app(app: OperatorApp) -> None:
    """Start the app's engine, if it has one, and show the app until the operator leaves.

    A signal ends the run as without a screen, then the app. Raises what ended the last run, and `ScreenCrashed`.
    """

    def on_signal(number: int) -> None:
        if app.engine is not None:
            app.engine.obey(number)
        app.leaving = True

    look_for_pixels()
    intact = False
    with stop_signals(on_signal):
        if app.engine is not None:
            app.engine.start()
        try:
            app.run()
            # A screen that ended because its terminal was lost did not crash.
            intact = app.leaving or not app.return_code
        finally:
            engine = app.engine
            # However the screen ended, nobody watches the arm from here on. An arm that is already parking continues.
            if engine is not None and not engine.finished and not app.leaving:
                engine.stop()
            if engine is not None and not intact:
                # The engine's thread dies with the process: let it bring the arm to rest and close the session first.
                with contextlib.suppress(CollectAborted):
                    engine.join()
        if not intact:
            raise ScreenCrashed("the screen crashed; the arm was stopped")
        if engine is not None:
            engine.join()
