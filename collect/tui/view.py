"""All that the run screen shows, as widgets that are handed one `Snapshot` after the other."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.containers import Horizontal, ScrollableContainer, Vertical, VerticalScroll
from textual.content import Content
from textual.widgets import Static

from collect.headless import eta_text
from collect.snapshot import Snapshot
from collect.states import FINAL, State
from collect.tui.grid import COMPLETE, Grid
from collect.tui.text import bar_text, minutes_text, one_line, plain, tip_text

SOFTWARE_STOP = "Stop is a software stop, not an emergency stop."
OVER = "Run is over: press q"
WARNING = "warning: "
LABEL = 9


class Line(Static):
    """Text that is drawn again only when it changed, and never read as markup."""

    def __init__(self, place: str) -> None:
        super().__init__(id=place, markup=False)
        self._shown: Content | None = None

    def show(self, content: Content) -> None:
        """Draw, if new."""
        if self._shown is None or not content.is_same(self._shown):
            self._shown = content
            self.update(content)


class RunView(Vertical):
    """One snapshot, drawn; holds nothing but what is on the screen."""

    DEFAULT_CSS = """
    RunView #title { height: 1; background: $panel; }
    RunView #session { width: 1fr; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis; }
    RunView #source {
        width: auto; max-width: 50%; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
        background: $accent; color: $text;
    }
    RunView #band { height: 5; margin: 1 0; }
    RunView #state {
        width: 22; height: 5; margin: 0 1; content-align: center middle; text-align: center; text-style: bold;
        background: $panel; color: $text;
    }
    RunView #state.-running { background: $success; }
    RunView #state.-recovering, RunView #state.-pausing, RunView #state.-stopping, RunView #state.-asking {
        background: $warning;
    }
    RunView #state.-paused { background: $primary; }
    RunView #state.-stopped, RunView #state.-failed { background: $error; }
    RunView #state.-done { background: $success-darken-2; }
    RunView #facts { width: 1fr; height: 5; text-wrap: nowrap; text-overflow: ellipsis; }
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
    RunView #grid-pane { height: auto; max-height: 60%; }
    RunView.-wrong #grid-pane { max-height: 40%; }
    RunView #log-pane { height: 1fr; }
    RunView #log { width: 1fr; height: auto; min-height: 100%; }
    RunView #note { height: 1; padding: 0 1; background: $panel; }
    """

    def __init__(self) -> None:
        super().__init__()
        # Held, not queried: a poll may come before the parts are mounted or after they are gone.
        self._session, self._source = Line("session"), Line("source")
        self._state, self._facts = Line("state"), Line("facts")
        self._why, self._why_pane = Line("why"), VerticalScroll(id="why-pane")
        self._grid, self._grid_pane = Grid(), ScrollableContainer(id="grid-pane", classes="pane")
        self._log, self._log_pane = Line("log"), VerticalScroll(id="log-pane", classes="pane")
        self._note = Line("note")
        self._messages: tuple[str, ...] = ()
        self._grid_pane.border_title = f"Strokes done/planned by depth H and tilt α ({COMPLETE} complete)"
        self._log_pane.border_title = "Log"

    def compose(self) -> ComposeResult:
        """Top to bottom, by how soon the operator needs it."""
        with Horizontal(id="title"):
            yield self._session
            yield self._source
        with Horizontal(id="band"):
            yield self._state
            yield self._facts
        with Vertical(id="body"):
            with self._why_pane:
                yield self._why
            with self._grid_pane:
                yield self._grid
            with self._log_pane:
                yield self._log
        yield self._note

    def on_mount(self) -> None:
        """Stay at the newest line until the operator scrolls away."""
        self._log_pane.anchor()

    def show(self, now: Snapshot) -> None:
        """Draw what differs from the last snapshot."""
        self._session.show(Content(f"brushloop  {one_line(now.session_id) or 'no session yet'}"))
        self._source.show(Content(f"source: {one_line(now.source) or 'not known yet'}"))
        self._state.show(_state_content(now.state))
        for state in State:
            self._state.set_class(state is now.state, f"-{state}")
        self._facts.show(_facts_content(now, self._facts.content_size.width))
        self.set_class(bool(now.error), "-wrong")
        failed = now.state is State.FAILED
        self._why_pane.border_title = "Why it failed" if failed else "Why it stopped"
        self._why.show(Content(plain(now.error)))
        self._grid.show(now.grid, self._grid_pane.scrollable_content_region.width)
        if now.messages != self._messages:
            self._messages = now.messages
            self._log.show(Content("\n").join(_message_content(line) for line in now.messages))
        self._note.show(_note_content(now.state))


def _state_content(state: State) -> Content:
    word = state.upper()
    return Content(f"{word}\nafter this step") if state is State.PAUSING else Content(word)


def _facts_content(now: Snapshot, width: int) -> Content:
    counts = bar_text(now.strokes_done, now.strokes_planned, 0)
    bar = bar_text(now.strokes_done, now.strokes_planned, max(width - LABEL - len(counts) - 1, 4))
    time = f"elapsed {minutes_text(now.elapsed_s)}"
    if now.state not in FINAL:
        time += f"   {eta_text(now) or 'no ETA yet'}"
    voids = f"{now.voids}   left out {now.given_up}" if now.given_up else str(now.voids)
    tip = tip_text(now.tip_mm)
    if now.force_n is not None:
        tip += f"   force {now.force_n:.3f} N"
    if now.ink_level is not None:
        tip += f"   ink {now.ink_level:.0%}"
    rows = (
        ("Step", one_line(now.step) or "-", "bold"),
        ("Strokes", bar, ""),
        ("Time", time, ""),
        ("Voids", voids, "bold $text-warning" if now.voids or now.given_up else ""),
        ("Tip", tip, "" if now.tip_mm else "bold $text-warning"),
    )
    lines = [Content.assemble((label.ljust(LABEL), "dim"), (text, style)) for label, text, style in rows]
    return Content("\n").join(lines)


def _message_content(line: str) -> Content:
    text = plain(line)
    return Content.styled(text, "bold $text-warning") if text.startswith(WARNING) else Content(text)


def _note_content(state: State) -> Content:
    if state not in FINAL:
        return Content(SOFTWARE_STOP)
    return Content.assemble((f" {OVER} ", "bold reverse"), f"  {SOFTWARE_STOP}")
