"""The start screen: recent sessions and their state, the rig and protocol files, the rig's health.

Heavy imports wait until they are needed, so that the screen is up first.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Footer, Input, OptionList

from brushloop.collect.errors import ConfigError
from brushloop.collect.tui.question_screens import YES, AskScreen, yes_or_no
from brushloop.collect.tui.widgets import HELP_KEY, Line, Rows, app_of, labelled, one_line, plain, trouble
from brushloop.sessions.errors import SessionError

if TYPE_CHECKING:
    from brushloop.collect.engine.engine import Engine
    from brushloop.sessions.show import Details, Summary

RECENT = 50
CHOSEN_FILES = ".files"
"""File in the folder of sessions that names the rig and the protocol chosen last."""
MAX_CHARS = 10_000
SIGNS = {"open": ("▶", "bold $text-warning"), "damaged": ("!", "bold $text-error")}


@dataclass(frozen=True, slots=True)
class Paths:
    """Paths of the rig, the protocol and the folder of sessions."""

    root: Path = Path("sessions")
    config: Path = Path("rig.toml")
    protocol: Path = Path("protocol.toml")


EngineFor = Callable[..., "Engine"]
"""Makes the engine of a run, not yet started; see `collect.start.engine_for`."""


class SessionBrowser:
    """Reads sessions and makes engines; connects to no device."""

    def __init__(self, paths: Paths, engine_for: EngineFor) -> None:
        self._kept = paths.root / CHOSEN_FILES
        self._engine_for = engine_for
        with contextlib.suppress(OSError, ValueError), self._kept.open(encoding="utf-8") as stream:
            config, protocol = stream.read(MAX_CHARS).splitlines()
            paths = replace(paths, config=Path(config), protocol=Path(protocol))
        self.paths = paths

    def choose(self, config: str, protocol: str) -> None:
        """Use another rig and another protocol, here and at the next start; an empty name keeps the file as it is."""
        before, names = self.paths, [config.strip(), protocol.strip()]
        self.paths = replace(before, config=Path(names[0] or before.config), protocol=Path(names[1] or before.protocol))
        if self.paths != before:
            with contextlib.suppress(OSError):  # then the choice holds until the program ends
                self._kept.parent.mkdir(parents=True, exist_ok=True)
                self._kept.write_text(f"{self.paths.config}\n{self.paths.protocol}\n", encoding="utf-8")

    def recent(self) -> list[Summary]:
        """The newest sessions first; empty if there is no folder yet."""
        from brushloop.sessions.show import summaries

        if not self.paths.root.is_dir():
            return []
        return sorted(summaries(self.paths.root), key=lambda row: row.session_id, reverse=True)[:RECENT]

    def standing(self, session_id: str) -> Details:
        """What of a session is finished, what is void and what comes next. Raises `SessionError`."""
        from brushloop.sessions.show import details

        return details(self.paths.root / session_id)

    def planned(self) -> str:
        """What the protocol would do, in one line. Raises `ConfigError`."""
        from brushloop.collect.planning.summary import make_plan
        from brushloop.collect.protocols.config import load_protocol
        from brushloop.collect.rig.config import load_rig

        plan = make_plan(load_rig(self.paths.config).settled(armed=False), load_protocol(self.paths.protocol))
        sheets = "1 sheet" if plan.sheets == 1 else f"{plan.sheets} sheets"
        return f"{len(plan.placed)} strokes on {sheets}, about {plan.seconds / 60:.0f} min"

    def engine(self, session_id: str | None, *, preview: bool) -> Engine:
        """An engine that resumes that open session, asking about its set-up; with None, one for a new session.

        A session goes on with its own protocol. Connects nothing yet. Raises `ConfigError`.
        """
        from brushloop.collect.engine.open_or_resume import PROTOCOL_EFFECTIVE, Opening

        root, config, protocol = self.paths.root, self.paths.config, self.paths.protocol
        if session_id is None:
            opening = Opening.load(root, config, protocol, new=True, sheet=1)
        else:
            opening = Opening.load(root, config, root / session_id / PROTOCOL_EFFECTIVE)
            opening = replace(opening, resume=session_id)
        return self._engine_for(opening, watched=True, guided=True, preview=preview)


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
    StartScreen #trouble { height: auto; max-height: 10; padding: 0 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("n", "new", "New session"),
        Binding("d", "health", "Rig health"),
        Binding("e", "files", "Files"),
        Binding("escape", "list", "Keep the old files"),
        Binding("q", "app.quit", "Leave"),
        HELP_KEY,
    ]

    def __init__(
        self,
        browser: SessionBrowser,
        begin: Callable[[str | None], object],
        look: Callable[[str], None],
        run_command: Callable[..., None],
    ) -> None:
        """`begin` resumes the named session, or begins a new one (None); `look` opens one for review; `run_command`
        hands the terminal to a command."""
        super().__init__()
        self._browser = browser
        self._begin = begin
        self._look = look
        self._run_command = run_command
        self._rows: list[Summary] = []
        self._title, self._standing = Line("start-title"), Line("standing-text")
        self._trouble = Line("trouble")
        self._options = Rows("sessions")
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
        with Horizontal(id="files"):
            for name, field in (("rig", self._config), ("protocol", self._protocol)):
                label = Line(f"{name}-label")
                label.show(name)
                yield label
                yield field
        yield self._trouble
        yield Footer(compact=True)

    def on_mount(self) -> None:
        """List the sessions."""
        self.reread()

    def on_screen_resume(self) -> None:
        """List the sessions again, as a run has changed them."""
        self.reread()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Escape has a meaning only while a file is typed."""
        if action == "list":
            return isinstance(self.focused, Input)
        return super().check_action(action, parameters)

    def reread(self) -> None:
        """Read the list of sessions again and show it."""
        self._title.show(f"brushloop   folder of the sessions: {one_line(str(self._browser.paths.root))}")
        try:
            self._rows = self._browser.recent()
        except (SessionError, OSError) as error:
            self.show_trouble(str(error))
            return
        self._options.fill(_row_content(row) for row in self._rows)
        self.set_class(not self._rows, "-empty")
        self._show_first_steps()

    def show_trouble(self, text: str) -> None:
        """Show what went wrong; an empty text clears it."""
        self._trouble.show(trouble(text))

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Show the state of the session under the cursor."""
        try:
            self._standing.show(_standing_content(self._browser.standing(self._rows[event.option_index].session_id)))
        except SessionError as error:
            self._standing.show(trouble(error))

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Resume an open session, or look through a closed one."""
        row = self._rows[event.option_index]
        self.show_trouble("")
        if row.state == "open":
            self._choose()
            self._begin(row.session_id)
        else:
            self._look(row.session_id)

    def on_input_submitted(self, _event: Input.Submitted) -> None:
        """Go back to the list with the typed files, and clear what was shown about the previous ones."""
        self._choose()
        self.show_trouble("")
        self._show_first_steps()
        self._options.focus()

    def action_list(self) -> None:
        """Go back to the list; files that were being typed stay as before."""
        self._show_files()
        self._options.focus()

    def action_files(self) -> None:
        """Let the operator type other files: tab goes to the other field, enter takes both."""
        self._config.focus()

    @work(exclusive=True, group="new")
    async def action_new(self) -> None:
        """Ask for a blank sheet, then begin."""
        self._choose()
        self.show_trouble("reading the files ...")
        try:
            planned = await asyncio.to_thread(self._browser.planned)
        except (ConfigError, OSError) as error:
            self.show_trouble(str(error))
            return
        self.show_trouble("")

        def answered(key: str | None) -> None:
            if key == YES:
                self._begin(None)

        question = yes_or_no(f"A new session: is a blank sheet in as its sheet 1?\n\n{planned}", "it is in", "back")
        app_of(self).push_screen(AskScreen(question), answered)

    def action_health(self) -> None:
        """Ask every device for its identity and its faults; powers nothing."""
        self._choose()
        self._run_command("doctor", "--config", str(self._browser.paths.config))

    def _show_first_steps(self) -> None:
        if not self._rows:
            self._standing.show(first_steps_content(self._browser.paths))

    def _choose(self) -> None:
        self._browser.choose(self._config.value, self._protocol.value)
        self._show_files()

    def _show_files(self) -> None:
        self._config.value, self._protocol.value = str(self._browser.paths.config), str(self._browser.paths.protocol)


def first_steps_content(paths: Paths) -> Content:
    """What to do before the first session, the files with a sign once they are there."""
    rig, protocol = ("✓" if path.is_file() else "·" for path in (paths.config, paths.protocol))
    return Content(f"""\
No session yet. First steps:

{rig} 1  The rig: {plain(str(paths.config))}
An arm: `brushloop rig new` writes it, step by step.
No arm: `brushloop sim --write-rig rig.toml --rate 20`, in another terminal.

{protocol} 2  What to press: {plain(str(paths.protocol))}
Copy examples/protocol-quick.toml, or press e and type another path.

· 3  Health: d asks every device; nothing is powered.

· 4  The first session: n
It asks for a blank sheet; the set-up looks through the camera, finds the paper, and asks you about each measurement.
Then the strokes follow.""")


def _row_content(row: Summary) -> Content:
    sign, style = SIGNS.get(row.state, ("✓", ""))
    return Content.assemble((sign, style), f" {one_line(row.session_id)} {row.state}")


def _standing_content(details: Details) -> Content:
    """What is finished, what is void, what comes next."""
    planned = "" if details.planned is None else f" of {details.planned}"
    bad = f", {details.marked_bad} marked bad" if details.marked_bad else ""
    parts = [
        Content.assemble((details.session_id, "bold"), f"  {details.state}\n{details.header.source}"),
        labelled("Finished", f"{details.strokes}{planned} strokes{bad}"),
    ]
    if details.void:
        parts.append(labelled("Void", Content.styled(f"{len(details.void)} cut short", "bold $text-warning")))
        parts += [Content(f"  × {plain(line)}") for line in details.void[-5:]]
    if details.state == "open":
        following = details.next or ("the next stroke" if details.strokes else "set-up")
        parts.append(labelled("Next", Content.styled(plain(following), "bold")))
        parts.append(Content("The arm first lifts and parks; then the run continues there. No stroke is made twice."))
    parts.append(labelled("Sheets", str(len(details.sheets))))
    if details.repairs:
        parts.append(Content.styled(f"{len(details.repairs)} repairs", "$text-warning"))
    return Content("\n").join(parts)
