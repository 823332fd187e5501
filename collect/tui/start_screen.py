"""The start screen: recent sessions and their state, the rig and protocol files, the rig's health.

Heavy imports wait until they are needed, so that the screen is up first.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Footer, OptionList

from brushloop.collect.engine import PROTOCOL_FILE, RIG_FILE, CollectRequest
from brushloop.collect.errors import ConfigError
from brushloop.collect.operator import Prompt
from brushloop.collect.tui.pictures import binary_picture, picture_widget
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    YES,
    AskScreen,
    Bar,
    Line,
    Rows,
    app_of,
    one_line,
    plain,
    trouble,
    yes_or_no,
)
from brushloop.sessions.errors import SessionError
from brushloop.sessions.journal import PROTOCOL_EFFECTIVE
from brushloop.sessions.terminal import text_of

if TYPE_CHECKING:
    from brushloop.collect.engine.engine import Engine
    from brushloop.sessions.show import Details, Summary

RECENT = 50
RESTS_S = 0.3
"""How long the cursor is on a session before its photographs are read."""
BESIDE_COLUMNS = 6
"""Columns beside the text about a session: its border, its padding and its scroll bar."""
SIGNS = {"open": ("▶", "bold $text-warning"), "damaged": ("!", "bold $text-error")}
GOES_ON = "The arm first lifts the brush and parks; then the run goes on. No stroke is made twice."


@dataclass(slots=True)
class SessionBrowser:
    """Reads sessions and makes engines; connects to no device."""

    root: Path = Path("sessions")
    """Folder that holds sessions."""
    config: Path = RIG_FILE
    protocol: Path = PROTOCOL_FILE
    """What to press; where there is no such file, the protocol of the newest session."""

    def recent(self) -> list[Summary]:
        """The newest sessions first; empty if there is no folder yet."""
        from brushloop.sessions.show import summaries

        if not self.root.is_dir():
            return []
        return sorted(summaries(self.root), key=lambda row: row.session_id, reverse=True)[:RECENT]

    def standing(self, session_id: str) -> Details:
        """What of a session is finished, what is void and what comes next. Raises `SessionError`."""
        from brushloop.sessions.show import details

        return details(self.root / session_id)

    def planned(self) -> str:
        """What the protocol would do, in one line. Raises `ConfigError`."""
        from brushloop.collect.plan import make_plan
        from brushloop.collect.protocols.config import load_protocol
        from brushloop.collect.rig.config import load_rig

        plan = make_plan(load_rig(self.config).settled(armed=False), load_protocol(self.protocol))
        sheets = "1 sheet" if plan.sheets == 1 else f"{plan.sheets} sheets"
        return f"{len(plan.placed)} strokes on {sheets}, about {plan.seconds / 60:.0f} min"

    def engine(self, session_id: str | None) -> Engine:
        """An engine that resumes that open session, asking about its set-up; with None, one for a new session.

        A session goes on with its own protocol. Connects nothing yet. Raises `ConfigError`.
        """
        from brushloop.collect.engine.engine import engine_for
        from brushloop.collect.engine.open_or_resume import Opening

        request = CollectRequest(self.config, self.protocol, self.root, on_screen=True, guided=True)
        if session_id is None:
            request = replace(request, new=True, sheet=1)
        else:
            request = replace(request, protocol=self.root / session_id / PROTOCOL_EFFECTIVE, resume=session_id)
        return engine_for(Opening.load(request))


class StartScreen(Screen[None]):
    """Lists sessions; resumes, begins, or looks through one."""

    AUTO_FOCUS = "#sessions"
    DEFAULT_CSS = """
    StartScreen #sessions { width: 42%; height: 100%; border: none; padding: 0; }
    StartScreen.-empty #sessions { display: none; }
    StartScreen #standing { width: 1fr; height: 100%; padding: 0 1; border-left: solid $foreground 40%; }
    StartScreen #marks { height: 9; display: none; }
    StartScreen #files { height: 1; padding: 0 1; }
    StartScreen #trouble { height: auto; max-height: 10; padding: 0 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("n", "new", "New session"),
        Binding("a", "analyse", "Analyse", tooltip="calibrate, fit and validate: from the photographs to the report"),
        Binding("d", "health", "Rig health"),
        Binding("e", "file('rig')", "Files"),
        Binding("q", "app.quit", "Leave"),
        HELP_KEY,
    ]

    def __init__(
        self,
        browser: SessionBrowser,
        begin: Callable[[Callable[[], Engine]], object],
        review: Callable[[Path], None],
        run_command: Callable[..., None],
    ) -> None:
        """What the app does: begin a run with an engine, review a session, hand the terminal to a command."""
        super().__init__()
        self._browser = browser
        self._begin, self._review, self._run_command = begin, review, run_command
        self._rows: list[Summary] = []
        self._title, self._standing = Bar("title"), Line("standing-text")
        self._marks = picture_widget("marks")
        self._files, self._trouble = Line("files"), Line("trouble")
        self._options = Rows("sessions")

    def compose(self) -> ComposeResult:
        """Lay out sessions and standing, files, trouble, keys."""
        yield self._title
        with Horizontal():
            yield self._options
            with VerticalScroll(id="standing"):
                yield self._marks
                yield self._standing
        yield self._files
        yield self._trouble
        yield Footer(compact=True)

    def on_screen_resume(self) -> None:
        """List the sessions, now and whenever a run may have changed them."""
        browser = self._browser
        self._title.show(f"brushloop   folder of the sessions: {one_line(str(browser.root))}")
        try:
            self._rows = browser.recent()
        except (SessionError, OSError) as error:
            self.show_trouble(str(error))
            return
        if self._rows and browser.protocol == PROTOCOL_FILE and not PROTOCOL_FILE.is_file():
            last = browser.root / self._rows[0].session_id / PROTOCOL_EFFECTIVE
            browser.protocol = last if last.is_file() else PROTOCOL_FILE
        self._files.show(f"rig {one_line(str(browser.config))}   protocol {one_line(str(browser.protocol))}")
        self._options.fill(_row_content(row) for row in self._rows)
        self.set_class(not self._rows, "-empty")
        if not self._rows:
            self._standing.show(first_steps_content(browser))

    def show_trouble(self, text: str) -> None:
        """Show what went wrong; an empty text clears it."""
        self._trouble.show(trouble(text))

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Show the state of the session under the cursor, as `brushloop sessions show` does."""
        from brushloop.sessions.show import renderables

        try:
            details = self._browser.standing(self._rows[event.option_index].session_id)
        except SessionError as error:
            self._standing.show(trouble(error))
            return
        goes_on = [GOES_ON] if details.state == "open" else []
        # What the list leaves of the screen, whether that is laid out yet or not.
        columns = app_of(self).size.width * 58 // 100 - BESIDE_COLUMNS
        self._standing.show(text_of([*goes_on, *renderables(details)], columns))
        self._show_marks(self._browser.root / details.session_id)

    @work(exclusive=True, group="marks")
    async def _show_marks(self, folder: Path) -> None:
        """Show the marks of a session, once the cursor rests on it; nothing where there are none to see."""
        from brushloop.collect.tui.review_screen import Review

        self._marks.display = False
        await asyncio.sleep(RESTS_S)
        with suppress(SessionError):  # an import, or a damaged session, which the text says
            if (ink := await asyncio.to_thread(lambda: Review(folder).marks())) is not None:
                self._marks.show(binary_picture(ink))
                self._marks.display = True

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Resume an open session, or look through a closed one."""
        row, browser = self._rows[event.option_index], self._browser
        self.show_trouble("")
        if row.state == "open":
            self._begin(partial(browser.engine, row.session_id))
        else:
            self._review(browser.root / row.session_id)

    def action_file(self, what: str) -> None:
        """Ask for the rig's file, then for the protocol's; an empty name, or escape, keeps a file as it is."""
        browser = self._browser
        paths = [*sorted(Path().glob(f"{what}*.toml")), *sorted(Path("examples").glob(f"{what}*.toml"))]
        listed = {str(number): path for number, path in enumerate(paths, 1)}

        def answered(name: str | None) -> None:
            path = listed.get(name.strip(), Path(name.strip())) if name and name.strip() else None
            if what == "rig":
                browser.config = path or browser.config
                self.action_file("protocol")
            else:
                browser.protocol = path or browser.protocol
                self.show_trouble("")
                self.on_screen_resume()

        before = str(browser.config if what == "rig" else browser.protocol)
        picks = "".join(f"\n{number}  {path}" for number, path in listed.items())
        question = f"Which {what} file? Type a number or a path; escape keeps {before}.{picks}"
        app_of(self).push_screen(AskScreen(Prompt(question, default=before, read=str)), answered)

    @work(exclusive=True, group="new")
    async def action_new(self) -> None:
        """Ask for a blank sheet, then begin."""
        self.show_trouble("reading the files ...")
        try:
            planned = await asyncio.to_thread(self._browser.planned)
        except (ConfigError, OSError) as error:
            self.show_trouble(str(error))
            return
        self.show_trouble("")

        def answered(key: str | None) -> None:
            if key == YES:
                self._begin(partial(self._browser.engine, None))

        question = f"New session: {planned}.\n\nHas a blank sheet been put in? It becomes sheet 1."
        app_of(self).push_screen(AskScreen(yes_or_no(question, "yes, begin", "back")), answered)

    def action_analyse(self) -> None:
        """Analyse the session under the cursor in this terminal."""
        if (at := self._options.highlighted) is not None:
            self._run_command("analyse", str(self._browser.root / self._rows[at].session_id))

    def action_health(self) -> None:
        """Ask every device for its identity and its faults; powers nothing."""
        self._run_command("doctor", "--config", str(self._browser.config))


def first_steps_content(browser: SessionBrowser) -> Content:
    """What to do before the first session, the files with a sign once they are there."""
    rig, protocol = ("✓" if path.is_file() else "·" for path in (browser.config, browser.protocol))
    return Content(f"""\
No session yet. First steps:

{rig} 1  The rig: {plain(str(browser.config))}
`brushloop rig new` writes it step by step; without an arm, `brushloop sim --write-rig rig.toml --rate 20` does.

{protocol} 2  What to press: {plain(str(browser.protocol))}
Press e for one of the examples, or for a file of your own.

· 3  Health: press d. Every device is asked; nothing is powered.

· 4  First session: press n. Lay a blank sheet and confirm each measurement; then the strokes follow.""")


def _row_content(row: Summary) -> Content:
    sign, style = SIGNS.get(row.state, ("✓", ""))
    return Content.assemble((sign, style), f" {one_line(row.session_id)} {row.state}")
