"""All that the run screen shows, as widgets that are handed one `Snapshot` after the other."""

from __future__ import annotations

from textual import events
from textual.app import ComposeResult
from textual.containers import Horizontal, ScrollableContainer, Vertical, VerticalScroll
from textual.content import Content

from collect.engine.snapshot import Snapshot
from collect.engine.states import FINAL, State
from collect.headless import no_pose_text
from collect.tui.capture import CapturePane
from collect.tui.facts import facts_content
from collect.tui.grid import LEGEND, Grid
from collect.tui.line import Line
from collect.tui.pictures import Pictures
from collect.tui.sheet import sheet_content, sheet_title
from collect.tui.text import SHORT_STOP, SOFTWARE_STOP, one_line, plain
from collect.tui.trace import plot

OVER = "Over: q leaves"
GOES_ON = "The same command goes on from here; this screen does not."
STOP_SENT = "STOP SENT"
WARNING = "warning: "
NARROW_COLUMNS, TALL_ROWS = 110, 36
PANES = ("overview", "capture", "camera")
TRACE_ROWS = 4


class RunView(Vertical):
    """One snapshot, drawn; holds nothing but what is on the screen."""

    DEFAULT_CSS = """
    RunView #title { height: 1; background: $panel; }
    RunView #session { width: 1fr; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis; }
    RunView #source {
        width: auto; max-width: 50%; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
        background: $accent; color: $text;
    }
    RunView #band { height: 7; }
    RunView #state {
        width: 18; height: 7; margin: 0 1; content-align: center middle; text-align: center; text-style: bold;
        background: $panel; color: $text;
    }
    RunView #state.-running { background: $success; }
    RunView #state.-recovering, RunView #state.-pausing, RunView #state.-stopping, RunView #state.-asking {
        background: $warning;
    }
    RunView #state.-paused { background: $primary; }
    RunView #state.-stopped, RunView #state.-failed { background: $error; }
    RunView #state.-done { background: $success-darken-2; }
    RunView #state.-silent { background: $error; }
    RunView #facts { width: 1fr; height: 7; text-wrap: nowrap; text-overflow: ellipsis; }
    RunView #body { height: 1fr; }
    RunView .pane {
        border-top: solid $foreground 40%; border-title-style: bold; border-title-color: $foreground; padding: 0 1;
    }
    RunView .pane:focus { border-top: solid $accent; }
    RunView #why-pane {
        display: none; height: auto; max-height: 60%; border: heavy $error; border-title-color: $text-error;
        border-title-style: bold; padding: 0 1;
    }
    RunView.-wrong #why-pane { display: block; }
    RunView #left { width: 1fr; }
    RunView #right { width: 45%; }
    RunView #top { height: auto; max-height: 60%; }
    RunView.-wrong #top { max-height: 70%; }
    RunView.-narrow.-wrong #sheet-pane { display: none; }
    RunView #grid-pane { width: 1fr; height: auto; }
    RunView #sheet-pane { width: auto; max-width: 40%; height: auto; min-width: 18; }
    RunView #trace-pane { height: 6; display: none; }
    RunView.-tall #trace-pane { display: block; }
    RunView #legend { width: auto; display: none; }
    RunView.-tall #legend { display: block; }
    RunView #log-pane { height: 1fr; }
    RunView #log { width: 1fr; height: auto; min-height: 100%; }
    RunView #camera-pane { height: 1fr; }
    RunView.-narrow #right { display: none; }
    RunView.-narrow.-capture #right, RunView.-narrow.-camera #right { display: block; width: 1fr; }
    RunView.-narrow.-capture #left, RunView.-narrow.-camera #left { display: none; }
    RunView.-narrow.-capture #camera-pane, RunView.-narrow.-camera #capture-pane { display: none; }
    RunView #note { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; text-overflow: ellipsis; }
    """

    def __init__(self, pictures: Pictures) -> None:
        super().__init__()
        # Held, not queried: a poll may come before the parts are mounted or after they are gone.
        self._session, self._source = Line("session"), Line("source")
        self._state, self._facts = Line("state"), Line("facts")
        self._why, self._why_pane = Line("why"), VerticalScroll(id="why-pane")
        self._grid, self._grid_pane = Grid(), ScrollableContainer(id="grid-pane", classes="pane")
        self._sheet = Line("sheet-pane", classes="pane")
        self._trace = Line("trace-pane", classes="pane")
        self._log, self._log_pane = Line("log"), VerticalScroll(id="log-pane", classes="pane")
        self._capture = CapturePane(pictures)
        self._camera, self._with_camera = pictures.make("camera-pane"), pictures.kind != "off"
        self._note = Line("note")
        self._messages: tuple[str, ...] = ()
        self._pane = 0
        self._stop_sent = False
        self._grid_pane.border_title = "Strokes done/planned by depth H and tilt α"
        self._legend = Line("legend")
        self._legend.show(Content.styled(LEGEND, "dim"))
        self._log_pane.border_title = "Log"
        self._trace.border_title = "Force, peaks by tenth of a second"
        self._camera.add_class("pane")
        self._camera.border_title = "Camera"

    def compose(self) -> ComposeResult:
        """Top to bottom, by how soon the operator needs it."""
        with Horizontal(id="title"):
            yield self._session
            yield self._source
        with Horizontal(id="band"):
            yield self._state
            yield self._facts
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

    def on_mount(self) -> None:
        """Stay at the newest line until the operator scrolls away."""
        self._log_pane.anchor()

    def on_resize(self, event: events.Resize) -> None:
        """What fits is decided by the terminal's size alone."""
        self.set_class(event.size.width < NARROW_COLUMNS, "-narrow")
        self.set_class(event.size.height >= TALL_ROWS, "-tall")

    def next_pane(self) -> None:
        """On a narrow screen: overview, last capture, camera in turn."""
        shown = PANES if self._with_camera else PANES[:-1]
        self._pane = (self._pane + 1) % len(shown)
        for name in PANES:
            self.set_class(name == shown[self._pane], f"-{name}")

    def stop_sent(self) -> None:
        """Show at once that the stop key was heard, before the engine has answered."""
        self._stop_sent = True
        self._state.show(STOP_SENT)
        self._state.set_class(True, "-stopping")

    def show(self, now: Snapshot) -> None:
        """Draw what differs from the last snapshot."""
        self._session.show(f"brushloop  {one_line(now.session_id) or 'no session yet'}")
        self._source.show(f"source: {one_line(now.source) or 'not known yet'}")
        self._show_state(now)
        self._facts.show(facts_content(now, self._facts.content_size.width))
        self.set_class(bool(now.error), "-wrong")
        failed = now.state is State.FAILED
        self._why_pane.border_title = "Why it failed" if failed else "Why it stopped"
        self._why.show(plain(now.error))
        self._grid.show(now.grid, self._grid_pane.scrollable_content_region.width)
        self._sheet.show(sheet_content(now.sheet))
        self._sheet.border_title = sheet_title(now.sheet)
        if self._trace.display:
            self._trace.show(plot(now.trace_n, self._trace.content_size.width, TRACE_ROWS))
        if now.messages != self._messages:
            self._messages = now.messages
            self._log.show(Content("\n").join(_message_content(line) for line in now.messages))
        self._capture.show(now.last)
        if now.picture is not None and self._camera.display:
            self._camera.show(now.picture.image)
        self._note.show(note_content(now))

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


def note_content(now: Snapshot) -> Content:
    """What was asked for by key and waits, and what the stop key is."""
    if now.state in FINAL:
        told = SOFTWARE_STOP if now.state is State.DONE or now.rest_unknown else GOES_ON
        return Content.assemble((f" {OVER} ", "bold reverse"), f"  {told}")
    if now.state is State.STOPPING:
        return Content.styled(" not seen at rest yet: the red button, if it moves on ", "bold reverse")
    if now.requests:
        asked = ", ".join(request.short for request in now.requests)
        return Content.assemble((f" asked: {asked} ", "bold reverse"), f" {SHORT_STOP}")
    return Content(SOFTWARE_STOP)
