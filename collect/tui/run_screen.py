"""The run screen: one `Snapshot` after the other, from the first retreat to the end of the run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, ScrollableContainer, Vertical, VerticalScroll
from textual.content import Content
from textual.screen import Screen

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.headless import no_pose_text
from brushloop.collect.tui.keys import RUN_BAR, keys_in
from brushloop.collect.tui.panes import LEGEND, CapturePane, Grid, figures_content, sheet_content, sheet_title
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.text import SHORT_STOP, SOFTWARE_STOP, one_line, plain, plot, plot_title
from brushloop.collect.tui.widgets import NARROW_COLUMNS, KeyBar, Line, entitle

OVER = "Over: q leaves"
GOES_ON = "Press enter to resume, or run the same command later."
COMMAND_GOES_ON = "Run the same command again to continue."
STOP_SENT = "STOP SENT"
WARNING = "warning: "
TALL_ROWS = 36
PANES = ("overview", "capture", "camera")
TRACE_ROWS = 4


class RunScreen(Screen[None]):
    """Draws snapshots; keeps only what is on the screen."""

    AUTO_FOCUS = "#log-pane"
    DEFAULT_CSS = """
    RunScreen #title { height: 1; background: $panel; }
    RunScreen #session { width: 1fr; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis; }
    RunScreen #source {
        width: auto; max-width: 50%; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
        background: $accent; color: $text;
    }
    RunScreen #band { height: 7; }
    RunScreen #state {
        width: 18; height: 7; margin: 0 1; content-align: center middle; text-align: center; text-style: bold;
        background: $panel; color: $text;
    }
    RunScreen #state.-running { background: $success; }
    RunScreen #state.-recovering, RunScreen #state.-pausing, RunScreen #state.-stopping, RunScreen #state.-asking {
        background: $warning;
    }
    RunScreen #state.-paused { background: $primary; }
    RunScreen #state.-stopped, RunScreen #state.-failed { background: $error; }
    RunScreen #state.-done { background: $success-darken-2; }
    RunScreen #state.-silent { background: $error; }
    RunScreen #figures { width: 1fr; height: 7; text-wrap: nowrap; text-overflow: ellipsis; }
    RunScreen #body { height: 1fr; }
    RunScreen .pane {
        border-top: solid $foreground 40%; border-title-style: bold; border-title-color: $foreground; padding: 0 1;
    }
    RunScreen .pane:focus { border-top: solid $accent; }
    RunScreen #why-pane {
        display: none; height: auto; max-height: 60%; border: heavy $error; border-title-color: $text-error;
        border-title-style: bold; padding: 0 1;
    }
    RunScreen.-wrong #why-pane { display: block; }
    RunScreen #left { width: 1fr; }
    RunScreen #right { width: 45%; }
    RunScreen #top { height: auto; max-height: 60%; }
    RunScreen.-wrong #top { max-height: 70%; }
    RunScreen.-narrow.-wrong #sheet-pane { display: none; }
    RunScreen #grid-pane { width: 1fr; height: auto; }
    RunScreen #sheet-pane { width: auto; max-width: 40%; height: auto; min-width: 18; }
    RunScreen #trace-pane { height: 6; display: none; }
    RunScreen.-tall #trace-pane { display: block; }
    RunScreen #legend { width: auto; display: none; }
    RunScreen.-tall #legend { display: block; }
    RunScreen #log-pane { height: 1fr; }
    RunScreen #log { width: 1fr; height: auto; min-height: 100%; }
    RunScreen #camera-pane { height: 1fr; }
    RunScreen.-narrow #right { display: none; }
    RunScreen.-narrow.-capture #right, RunScreen.-narrow.-camera #right { display: block; width: 1fr; }
    RunScreen.-narrow.-capture #left, RunScreen.-narrow.-camera #left { display: none; }
    RunScreen.-narrow.-capture #camera-pane, RunScreen.-narrow.-camera #capture-pane { display: none; }
    RunScreen #note { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; text-overflow: ellipsis; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("tab", "next_pane", "Next pane")]

    def __init__(
        self, pictures: Pictures, *, resumable: bool = False, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`resumable`: whether this screen can go on with a run that was stopped. `now_s` is the clock of ages."""
        super().__init__()
        self._resumable = resumable
        # Kept, not queried: a snapshot may come before the parts are mounted or after they are gone.
        self._session, self._source = Line("session"), Line("source")
        self._state, self._figures = Line("state", sized=True), Line("figures", sized=True)
        self._why, self._why_pane = Line("why"), VerticalScroll(id="why-pane")
        self._grid, self._grid_pane = Grid(), ScrollableContainer(id="grid-pane", classes="pane")
        self._sheet = Line("sheet-pane", classes="pane")
        self._trace = Line("trace-pane", classes="pane", sized=True)
        self._log, self._log_pane = Line("log"), VerticalScroll(id="log-pane", classes="pane")
        self._capture = CapturePane(pictures, now_s)
        self._camera, self._with_camera = pictures.make("camera-pane"), pictures.camera_shown
        self._note, self._keys = Line("note", sized=True), KeyBar(RUN_BAR)
        self._messages: tuple[str, ...] = ()
        self._pane = 0
        self._doing: tuple[State, str] | None = None
        self._turn = 0
        self._stop_sent = False
        self._grid_pane.border_title = "Strokes done/planned by depth H and tilt α"
        self._legend = Line("legend")
        self._legend.show(Content.styled(LEGEND, "dim"))
        self._log_pane.border_title = "Log"
        self._camera.add_class("pane")
        self._camera.border_title = "Camera"

    def compose(self) -> ComposeResult:
        """Lay out top to bottom, by how soon the operator needs it."""
        with Horizontal(id="title"):
            yield self._session
            yield self._source
        with Horizontal(id="band"):
            yield self._state
            yield self._figures
        with self._why_pane:
            yield self._why
        with Horizontal(id="body"):
            with Vertical(id="left"):
                with Horizontal(id="top"):
                    with self._grid_pane:
                        yield self._grid
                        yield self._legend
                    yield self._sheet
                yield self._trace
                with self._log_pane:
                    yield self._log
            with Vertical(id="right"):
                yield self._capture
                if self._with_camera:
                    yield self._camera
        yield self._note
        yield self._keys

    def on_mount(self) -> None:
        """Keep the log at its newest line until the operator scrolls away."""
        self._log_pane.anchor()

    def on_resize(self, event: events.Resize) -> None:
        """Choose what to show for the terminal's size."""
        self.set_class(event.size.width < NARROW_COLUMNS, "-narrow")
        self.set_class(event.size.height >= TALL_ROWS, "-tall")

    def action_next_pane(self) -> None:
        """Show overview, last capture, and camera in turn, on a narrow screen."""
        shown = PANES if self._with_camera else PANES[:-1]
        self._pane = (self._pane + 1) % len(shown)
        for name in PANES:
            self.set_class(name == shown[self._pane], f"-{name}")

    def stop_sent(self) -> None:
        """Show at once that a stop key was pressed, before the engine answers."""
        self._stop_sent = True
        self._state.show(STOP_SENT)
        self._state.set_class(True, "-stopping")

    def show(self, now: Snapshot) -> None:
        """Draw what differs from the previous snapshot.

        Parts that change all the time take turns (figures 5 times a second, camera 5, trace 2.5), because textual
        visits every widget between two that it draws at the same time. A new state or step is shown at once.
        """
        self._turn = 0 if self._doing != (now.state, now.step) else self._turn + 1
        self._doing = now.state, now.step
        figures_turn, trace_turn = self._turn % 2 == 0, self._turn % 4 == 1
        self._session.show(f"brushloop  {one_line(now.session_id) or 'no session yet'}")
        self._source.show(f"source: {one_line(now.source) or 'not known yet'}")
        self._show_state(now)
        if figures_turn:
            self._figures.show(figures_content(now, self._figures.content_size.width))
        self.set_class(bool(now.error), "-wrong")
        failed = now.state is State.FAILED
        entitle(self._why_pane, "Why it failed" if failed else "Why it stopped")
        self._why.show(plain(now.error))
        self._grid.show(now.grid, self._grid_pane.scrollable_content_region.width)
        self._sheet.show(sheet_content(now.sheet))
        entitle(self._sheet, sheet_title(now.sheet))
        if self._trace.display and trace_turn:
            self._trace.show(plot(now.trace_n, self._trace.content_size.width, TRACE_ROWS, now.force_ceiling_n))
            entitle(self._trace, plot_title(now.force_ceiling_n))
        if now.messages != self._messages:
            self._messages = now.messages
            self._log.show(Content("\n").join(_message_content(line) for line in now.messages))
        self._capture.show(now.last)
        if now.picture is not None and self._camera.display and not figures_turn:
            self._camera.show(now.picture.image)
        resumable = self._resumable and bool(now.folder)
        self._note.show(_note_content(now, resumable=resumable))
        self._keys.show(keys_in(now.state, RUN_BAR, resumable=resumable))

    def _show_state(self, now: Snapshot) -> None:
        state = now.state
        self._stop_sent = self._stop_sent and state not in FINAL | {State.STOPPING}
        words = [STOP_SENT if self._stop_sent else _state_text(state), no_pose_text(now)]
        self._state.show("\n".join(filter(None, words)))
        self._state.set_class(now.no_pose_s is not None, "-silent")
        for known in State:
            self._state.set_class(known is (State.STOPPING if self._stop_sent else state), f"-{known}")


def _state_text(state: State) -> str:
    word = state.upper()
    return f"{word}\nafter this step" if state is State.PAUSING else word


def _message_content(line: str) -> Content:
    text = plain(line)
    return Content.styled(text, "bold $text-warning") if text.startswith(WARNING) else Content(text)


def _note_content(now: Snapshot, *, resumable: bool) -> Content:
    """Pending requests and the stop key; once the run is over, how to leave."""
    if now.state in FINAL:
        on = GOES_ON if resumable else COMMAND_GOES_ON
        following = SOFTWARE_STOP if now.state is State.DONE or now.rest_unknown else on
        return Content.assemble((f" {OVER} ", "bold reverse"), f"  {following}")
    if now.state is State.STOPPING:
        return Content.styled(" not seen at rest yet: press the red button if it moves ", "bold reverse")
    if now.requests:
        asked = ", ".join(request.short for request in now.requests)
        return Content.assemble((f" asked: {asked} ", "bold reverse"), f" {SHORT_STOP}")
    return Content(SOFTWARE_STOP)
