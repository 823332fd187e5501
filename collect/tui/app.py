"""The run screen: looks at the engine ten times a second; its keys pause, resume and stop."""

from __future__ import annotations

import contextlib
import threading
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.widgets import Footer

from collect.asking import Prompt
from collect.errors import CollectAborted
from collect.headless import REFRESH_S, RunnableEngine, stopping_signals
from collect.snapshot import EngineView, Snapshot
from collect.states import FINAL, State
from collect.tui.ask import AskScreen
from collect.tui.confirm import ConfirmQuit
from collect.tui.terminal import TerminalDriver
from collect.tui.view import RunView

CAN_PAUSE = frozenset({State.IDLE, State.RECOVERING, State.RUNNING})
CAN_RESUME = frozenset({State.PAUSING, State.PAUSED})


class ScreenCrashed(Exception):
    """The screen ended by a defect of its own, which it has printed; the arm was stopped."""


class RunApp(App[None]):
    """The operator's screen for one run."""

    CSS = """
    Screen { layout: vertical; }
    """
    TITLE = "brushloop"
    ENABLE_COMMAND_PALETTE = False
    # A selection would be copied with ctrl+c, which is a stop key here.
    ALLOW_SELECT = False
    AUTO_FOCUS = "#log-pane"
    # The stop keys have priority: no focus, no dialog is ever between the operator and a stop.
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("p", "pause", "Pause"),
        Binding("p", "resume", "Resume"),
        Binding("s", "stop", "Stop arm", key_display="s, ctrl+c", priority=True),
        Binding("ctrl+c", "stop", "Stop arm", show=False, priority=True),
        Binding("q", "quit", "Quit"),
    ]

    def __init__(self, engine: EngineView) -> None:
        super().__init__(driver_class=TerminalDriver)
        self._engine = engine
        self._now: Snapshot = engine.snapshot()
        self._leave = threading.Event()

    def compose(self) -> ComposeResult:
        """The view and the keys."""
        yield RunView()
        yield Footer()

    def on_mount(self) -> None:
        """Look now, then at 10 Hz."""
        self._view = self.query_one(RunView)
        self.call_after_refresh(self._look)
        self.set_interval(REFRESH_S, self._look)

    @property
    def leaving(self) -> bool:
        """True once asked to leave."""
        return self._leave.is_set()

    def leave(self) -> None:
        """End the screen soon, whatever the state; from any thread."""
        self._leave.set()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Hide the half of pause and resume that does not apply."""
        if action == "pause":
            return self._now.state in CAN_PAUSE
        if action == "resume":
            return self._now.state in CAN_RESUME
        return super().check_action(action, parameters)

    def action_pause(self) -> None:
        """Pause before the next step."""
        self._engine.pause()

    def action_resume(self) -> None:
        """Go on."""
        self._engine.resume()

    def action_stop(self) -> None:
        """Stop the arm, without a question."""
        self._engine.stop()

    async def action_quit(self) -> None:
        """Leave; asks first while the run is on."""
        if self._engine.snapshot().state in FINAL:
            self.exit()
        elif not isinstance(self.screen, ConfirmQuit):
            self.push_screen(ConfirmQuit(), self._answered)

    def _answered(self, yes: bool | None) -> None:
        if yes:
            self._engine.stop()
            self.exit()

    def _look(self) -> None:
        if self.leaving:
            self.exit()
        before, self._now = self._now, self._engine.snapshot()
        self._view.show(self._now)
        self._ask(self._now.prompt)
        if self._now.state is not before.state:
            self.refresh_bindings()

    def _ask(self, prompt: Prompt | None) -> None:
        shown = next((screen for screen in self.screen_stack if isinstance(screen, AskScreen)), None)
        if shown is not None and prompt is not None and shown.prompt.number == prompt.number:
            shown.tell_time()
            return
        if shown is not None and shown is self.screen:
            self.pop_screen()
        if prompt is not None and not isinstance(self.screen, ConfirmQuit | AskScreen):
            self.push_screen(AskScreen(prompt, self._engine))


class _StopAndLeave:
    """What signals may do: one may mean that nobody is there to press q."""

    def __init__(self, engine: EngineView, app: RunApp) -> None:
        self._engine = engine
        self._app = app

    def stop(self) -> None:
        """Stop the arm first, then end the screen."""
        self._engine.stop()
        self._app.leave()


def run_screen(engine: RunnableEngine) -> None:
    """Run under the screen until the operator leaves; raises what ended the run."""
    app = RunApp(engine)
    with stopping_signals(_StopAndLeave(engine, app)):
        engine.start()
        intact = False
        try:
            app.run()
            # A screen that lost its terminal was told to leave; that is no defect.
            intact = app.leaving or not app.return_code
        finally:
            # However the screen ended, nobody watches the arm any more.
            if not engine.finished:
                engine.stop()
            if not intact:
                # The engine's thread dies with the process: let it bring the arm to rest and close the session first.
                with contextlib.suppress(CollectAborted):
                    engine.join()
        if not intact:
            raise ScreenCrashed("the screen crashed; the arm was stopped")
        engine.join()
