"""The app of the first day: polls what the steps show, and stops the arm by key from every state."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, ClassVar

from textual import events
from textual.binding import Binding, BindingType

from brushloop.collect.errors import CollectAborted, describe
from brushloop.collect.headless import REFRESH_S, stop_signals
from brushloop.collect.tui.keys import is_stop_key
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.question_screens import Confirm
from brushloop.collect.tui.teach_guide import ScreenGuide, Teaching
from brushloop.collect.tui.teach_screen import GO_ON, LEAVE, TeachScreen
from brushloop.collect.tui.terminal import PlainApp, theme_file
from brushloop.collect.tui.text import SOFTWARE_STOP
from brushloop.collect.tui.widgets import HelpScreen

Work = Callable[[ScreenGuide], Coroutine[Any, Any, Path | None]]
AT_WORK = ("A step is running: stop it and leave?", "y  stop and leave      n  go on      s  stop now")
STOPPED = "Stopped. Look at the arm before you go on.\ng  go on from the last question   q  leave, all is kept"
DONE = "This is done.   q  leave"
HELP = f"""\
enter     accept the suggested answer, or confirm that the tip is there
esc       go back one question: the answer or touch before it is taken back
k         skip this point, where the step can do without it
q         leave; everything taught is kept, the same command resumes
ctrl-q    the same while you type
s, ctrl-c stop the arm at once (ctrl-c while you type)
tab       picture, on a narrow screen
page up   older findings; page down: newer ones
j         with --arm: bring the tip the last millimetres by keys

Jog: arrows move along base x and y, page up and down along z, 1 to 4
choose the size of a step. Every step is checked against the box that is
known so far: 25 mm around all touched points and where your hand left the
arm, and 5 mm below. The arm moves at 20 mm/s.

{SOFTWARE_STOP}"""


class TeachApp(PlainApp):
    """Runs the steps, shows them, and carries the keys to them."""

    TITLE = "brushloop"
    ALLOW_SELECT = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "leave", "Leave"),
        Binding("ctrl+q", "leave", "Leave", show=False, priority=True),
        Binding("question_mark", "help", "Help"),
        Binding("g", "go_on", "Go on", show=False),
    ]

    def __init__(self, work: Work, name: str, pictures: Pictures | None = None, theme_file: Path | None = None) -> None:
        super().__init__(theme_file)
        self._work = work
        self._pictures = pictures or Pictures()
        self.teaching = Teaching(work)
        self._screen = TeachScreen(self.teaching.guide, name, self._pictures)
        self._ending = False
        self._signalled = False

    def on_mount(self) -> None:
        """Start the steps; then look ten times a second."""
        self.push_screen(self._screen)
        self.teaching.start()
        self.set_interval(REFRESH_S, self._poll)

    async def on_event(self, event: events.Event) -> None:
        """Stop keys come first, on every screen; `s` is a letter only while a line is typed."""
        if is_stop_key(event) and not self.teaching.finished:
            typing = self._screen.typing and self.screen is self._screen
            if not (typing and event.is_printable):
                self.action_stop()
                return
        await super().on_event(event)

    @property
    def asking(self) -> bool:
        """Whether the question of the moment is on the screen."""
        return self._screen.asking

    def action_stop(self) -> None:
        """Stop whatever is under way, and say so at once."""
        self.teaching.stop()
        if self._screen.is_mounted:
            self._screen.stop_sent()

    def action_leave(self) -> None:
        """Leave; where something is at work, ask first."""
        if isinstance(self.screen, Confirm):
            return
        if self.teaching.finished:
            self.exit()
        elif self._screen.asking:
            self._ending = True
            self.teaching.guide.leave()
        else:
            self.push_screen(Confirm(*AT_WORK), self._stop_and_leave)

    def _stop_and_leave(self, yes: bool | None) -> None:
        if yes:
            self._ending = True
            self.action_stop()

    def action_go_on(self) -> None:
        """After a stop, start the steps again; what the notebook already holds is not asked again."""
        if self.teaching.finished and self.teaching.stopped and self.teaching.error is None:
            self.teaching = Teaching(self._work, self.teaching.guide.view.findings)
            self._screen.follow(self.teaching.guide)
            self.teaching.start()

    def action_help(self) -> None:
        """Show every key."""
        if not isinstance(self.screen, HelpScreen):
            self.push_screen(HelpScreen(HELP))

    def leave_soon(self) -> None:
        """End the app, from any thread: a signal came."""
        self._signalled = True

    def _poll(self) -> None:
        if not self.is_running or not self._screen.is_mounted:
            return
        over = ""
        if self.teaching.finished:
            error = self.teaching.error
            if self._signalled or isinstance(error, CollectAborted) or (self._ending and error is None):
                self.exit()
                return
            over = describe(error) + "\nq  leave" if error is not None else STOPPED if self.teaching.stopped else DONE
        keys = GO_ON if over == STOPPED else LEAVE
        self._screen.show(self.teaching.guide.view, over, keys)


def run_teaching(work: Work, name: str, pictures: Pictures | None = None) -> Path | None:
    """Show the screen until the person leaves; returns the `rig.toml` that was written, raises what ended the steps.

    However the screen ends, nobody watches the arm from here on: whatever moves it is stopped.
    """
    app = TeachApp(work, name, pictures, theme_file())

    def on_signal(_: int) -> None:
        app.teaching.stop()
        app.leave_soon()

    with stop_signals(on_signal):
        try:
            app.run()
        finally:
            if not app.teaching.finished:
                app.teaching.stop()
    app.teaching.join()
    if app.teaching.stopped:
        raise CollectAborted("stopped; the same command resumes from there")
    return app.teaching.written
