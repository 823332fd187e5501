"""The start screen: recent sessions and their state, the rig and protocol files, the rig's health."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Input, OptionList

from brushloop.collect.errors import ConfigError
from brushloop.collect.tui.browser import Paths, SessionBrowser
from brushloop.collect.tui.question_screens import Confirm
from brushloop.collect.tui.text import age_text, one_line, plain
from brushloop.collect.tui.widgets import KeyBar, Line, Rows, app_of
from brushloop.sessions.errors import SessionError

if TYPE_CHECKING:
    from brushloop.collect.rig.doctor import Finding
    from brushloop.sessions.show import Details, Summary

KEYS = (
    ("enter", "open"),
    ("n", "new session"),
    ("d", "rig health"),
    ("e", "files"),
    ("?", "help"),
    ("q", "leave"),
    ("ctrl-p", "commands"),
)
TYPING_KEYS = (("enter", "use these files"), ("tab", "the other file"), ("escape", "keep the old files"))
UNASKED = Content.styled("Rig health: d asks every device; powers nothing, moves nothing", "dim")
AGE_S = 5.0
"""Interval at which the age of the rig's health is updated."""
SIGNS = {
    "open": ("▶", "bold $text-warning"),
    "damaged": ("!", "bold $text-error"),
}
FRESH = "A new session: is a blank sheet in as its sheet 1?"


class StartScreen(Screen[None]):
    """Lists sessions; resumes, begins, or looks through one."""

    AUTO_FOCUS = "#sessions"
    DEFAULT_CSS = """
    StartScreen #start-title { height: 1; padding: 0 1; background: $panel; text-style: bold; }
    StartScreen #start-body { height: 1fr; }
    StartScreen #sessions { width: 42%; height: 100%; border: none; padding: 0; }
    StartScreen.-empty #sessions { display: none; }
    StartScreen #standing { width: 1fr; height: 100%; padding: 0 1; border-left: solid $foreground 40%; }
    StartScreen #files { height: 1; }
    StartScreen #files Line { width: auto; padding: 0 1; }
    StartScreen #files Input { width: 1fr; height: 1; border: none; padding: 0; }
    StartScreen #health { height: auto; max-height: 10; padding: 0 1; border-top: solid $foreground 40%; }
    StartScreen #trouble { height: auto; max-height: 10; padding: 0 1; color: $text-error; text-style: bold; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("n", "new", "New session"),
        Binding("d", "health", "Rig health"),
        Binding("e", "files", "Files"),
        Binding("escape", "list", "Sessions", show=False),
    ]

    def __init__(
        self,
        browser: SessionBrowser,
        begin: Callable[[str | None], object],
        look: Callable[[str], None],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """`begin` resumes the named session, or begins a new one (None); `look` opens one for review."""
        super().__init__()
        self._browser = browser
        self._begin = begin
        self._look = look
        self._now_s = now_s
        self._findings: list[Finding] = []
        self._asked_s: float | None = None
        self._rows: list[Summary] = []
        self._title, self._standing = Line("start-title"), Line("standing-text")
        self._health, self._trouble = Line("health-text"), Line("trouble")
        self._options = Rows("sessions")
        self._keys = KeyBar(KEYS)
        paths = browser.paths
        self._config = Input(str(paths.config), id="config", compact=True, select_on_focus=False)
        self._protocol = Input(str(paths.protocol), id="protocol", compact=True, select_on_focus=False)

    def compose(self) -> ComposeResult:
        """Lay out sessions and standing, health, files, keys."""
        yield self._title
        with Horizontal(id="start-body"):
            yield self._options
            with VerticalScroll(id="standing"):
                yield self._standing
        with Vertical(id="health"):
            yield self._health
        with Horizontal(id="files"):
            yield Line("rig-label")
            yield self._config
            yield Line("protocol-label")
            yield self._protocol
        yield self._trouble
        yield self._keys

    def on_mount(self) -> None:
        """List the sessions."""
        self.query_one("#rig-label", Line).show("rig")
        self.query_one("#protocol-label", Line).show("protocol")
        self._health.show(UNASKED)
        self.reread()
        self.set_interval(AGE_S, self._show_health)

    def on_screen_resume(self) -> None:
        """List the sessions again, as a run has changed them."""
        self.reread()

    def reread(self) -> None:
        """Read the list of sessions again and show it."""
        self._title.show(f"brushloop   folder of the sessions: {one_line(str(self._browser.paths.root))}")
        try:
            self._rows = self._browser.recent()
        except (SessionError, OSError) as error:
            self.show_trouble(str(error))
            return
        self._options.fill([(row.session_id, _row_content(row)) for row in self._rows])
        self.set_class(not self._rows, "-empty")
        if self._rows:
            self._options.highlighted = 0
        else:
            self._show_first_steps()

    def show_trouble(self, text: str) -> None:
        """Show what went wrong; an empty text clears it."""
        self._trouble.show(plain(text))

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Show the state of the session under the cursor."""
        self._show_standing(str(event.option.id))

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Resume an open session, or look through a closed one."""
        row = next(row for row in self._rows if row.session_id == event.option.id)
        self.show_trouble("")
        if row.state == "open":
            self._choose()
            self._begin(row.session_id)
        else:
            self._look(row.session_id)

    def on_input_submitted(self, _event: Input.Submitted) -> None:
        """Go back to the list with the typed files, and clear what was shown about the previous ones."""
        self._choose()
        self._asked_s = None
        self._health.show(UNASKED)
        self.show_trouble("")
        self._show_first_steps()
        self._to_list()

    def action_list(self) -> None:
        """Go back to the list; files that were being typed stay as before."""
        self._show_files()
        self._to_list()

    def action_files(self) -> None:
        """Let the operator type other files."""
        self._keys.show(TYPING_KEYS)
        self._config.focus()

    def _to_list(self) -> None:
        self._keys.show(KEYS)
        self._options.focus()

    @work(exclusive=True, group="new")
    async def action_new(self) -> None:
        """Ask for a blank sheet, then begin."""
        self._choose()
        self.show_trouble("reading the files ...")
        try:
            question = f"{FRESH}\n\n{await asyncio.to_thread(self._browser.planned)}"
        except (ConfigError, OSError) as error:
            self.show_trouble(str(error))
            return
        self.show_trouble("")

        def answered(yes: bool | None) -> None:
            if yes:
                self._begin(None)

        app_of(self).push_screen(Confirm(question, "y  it is in: begin      n  back"), answered)

    @work(exclusive=True, group="health")
    async def action_health(self) -> None:
        """Check every device, outside the screen's event loop."""
        self._choose()
        self._health.show("Rig health: asking every device ...")
        try:
            findings = await asyncio.to_thread(self._browser.health)
        except (ConfigError, OSError) as error:
            self._health.show(Content.styled(f"Rig health: {plain(str(error))}", "$text-error"))
            return
        self._findings, self._asked_s = findings, self._now_s()
        self._show_health()
        self._show_first_steps()

    def _show_health(self) -> None:
        if self._asked_s is not None:
            age = Content.styled(f"Rig health, {age_text(self._now_s() - self._asked_s)}; d asks again", "dim")
            self._health.show(Content("\n").join((age, _health_content(self._findings))))

    def _show_first_steps(self) -> None:
        if not self._rows:
            well = self._asked_s is not None and all(finding.well for finding in self._findings)
            self._standing.show(first_steps_content(self._browser.paths, well=well))

    def _choose(self) -> None:
        self._browser.choose(self._config.value, self._protocol.value)
        self._show_files()

    def _show_files(self) -> None:
        self._config.value, self._protocol.value = str(self._browser.paths.config), str(self._browser.paths.protocol)

    def _show_standing(self, session_id: str) -> None:
        try:
            self._standing.show(_standing_content(self._browser.standing(session_id)))
        except SessionError as error:
            self._standing.show(Content.styled(plain(str(error)), "$text-error"))


def first_steps_content(paths: Paths, *, well: bool) -> Content:
    """What to do before the first session, each step with a sign once it is done."""
    steps = (
        (
            paths.config.is_file(),
            f"The rig: {plain(str(paths.config))}",
            "An arm: `brushloop rig new` writes it, step by step.\n"
            "No arm: `brushloop sim --write-rig rig.toml --rate 20`, in another terminal.",
        ),
        (
            paths.protocol.is_file(),
            f"What to press: {plain(str(paths.protocol))}",
            "Copy examples/protocol-quick.toml, or press e and type another path.",
        ),
        (well, "Health: d asks every device", "Nothing is powered, and nothing moves from this screen."),
        (
            False,
            "The first session: n",
            "It asks for a blank sheet; the set-up looks through the camera, finds the paper, and asks you "
            "about each measurement. Then the strokes follow.",
        ),
    )
    parts = [Content.styled("No session yet. First steps:", "bold")]
    for number, (done, title, what) in enumerate(steps, 1):
        sign = ("✓", "$text-success") if done else ("·", "dim")
        parts.append(Content.assemble("\n", sign, f" {number}  ", (title, "bold")))
        if not done:
            parts.append(Content.styled(what, "dim"))
    return Content("\n").join(parts)


def _row_content(row: Summary) -> Content:
    sign, style = SIGNS.get(row.state, ("✓", ""))
    return Content.assemble((sign, style), f" {one_line(row.session_id)} {row.state}")


def _standing_content(details: Details) -> Content:
    """What is finished, what is void, what comes next."""
    planned = "" if details.planned is None else f" of {details.planned}"
    bad = f", {details.marked_bad} marked bad" if details.marked_bad else ""
    parts = [
        Content.assemble((details.session_id, "bold"), f"  {details.state}\n{details.header.source}"),
        Content.assemble(("Finished  ", "dim"), (f"{details.strokes}{planned} strokes", "bold"), bad),
    ]
    if details.void:
        parts.append(Content.assemble(("Void      ", "dim"), (f"{len(details.void)} cut short", "bold $text-warning")))
        parts += [Content(f"  × {plain(line)}") for line in details.void[-5:]]
    if details.state == "open":
        following = details.next or ("the next stroke" if details.strokes else "set-up")
        parts.append(Content.assemble(("Next      ", "dim"), (plain(following), "bold")))
        parts.append(Content("The arm first lifts and parks; then the run continues there. No stroke is made twice."))
    parts.append(Content.assemble(("Sheets    ", "dim"), f"{len(details.sheets)}"))
    if details.repairs:
        parts.append(Content.styled(f"{len(details.repairs)} repairs", "$text-warning"))
    return Content("\n").join(parts)


def _health_content(findings: list[Finding]) -> Content:
    """One line for each device, its verdict as a sign and in words."""
    lines: list[Content] = []
    for finding in findings:
        sign = ("✓ well   ", "$text-success") if finding.well else ("! trouble", "bold $text-error")
        latency = "" if finding.latency_ms is None else f"  {finding.latency_ms:.0f} ms"
        what = finding.notes if finding.well else f"{finding.problem}. {finding.remedy}"
        lines.append(Content.assemble(sign, f" {finding.device:<7}{latency}  {one_line(what)}"))
    return Content("\n").join(lines)
