"""The end of a session: reads its recording again, and offers to calibrate, fit and report."""

from __future__ import annotations

import asyncio
from pathlib import Path
from traceback import format_exception
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.content import Content
from textual.screen import ModalScreen

from brushloop.collect.tui.text import plain
from brushloop.collect.tui.widgets import Line
from brushloop.sessions.errors import SessionError
from brushloop.sessions.terminal import Printable, Progress, text_of

if TYPE_CHECKING:
    from brushloop.sessions.verify import Verdict

MOST_LINES = 400
"""Number of lines shown of a command's output: the last ones."""
COLUMNS = 68
"""Width that commands format their output for: that of this page on a terminal of 80 columns."""


class FinishScreen(ModalScreen[None]):
    """Verifies the session at once; runs each further command on a key, in a thread."""

    DEFAULT_CSS = """
    FinishScreen { align: center middle; }
    FinishScreen VerticalScroll {
        width: 90%; max-width: 100; height: auto; max-height: 95%; padding: 0 2;
        border: heavy $accent; background: $surface;
    }
    FinishScreen Line { margin-bottom: 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("c", "command('calibrate')", "Calibrate"),
        Binding("t", "command('fit')", "Fit the brush"),
        Binding("w", "command('validate')", "Report"),
        Binding("escape,q", "close", "Back"),
    ]

    def __init__(self, folder: Path, *, is_open: bool) -> None:
        super().__init__()
        self._folder = folder
        self._open = is_open
        self._verdict, self._next, self._said = Line("verdict"), Line("next"), Line("said")
        self._busy = False

    def compose(self) -> ComposeResult:
        """Lay out the verdict, the next commands and the output of a command."""
        with VerticalScroll() as page:
            page.border_title = "Finish"
            yield self._verdict
            yield self._next
            yield self._said

    def on_mount(self) -> None:
        """Begin to verify."""
        self._verdict.show("Reading every file again ...")
        self._next.show(self._next_content())
        self._verify()

    def action_close(self) -> None:
        """Go back to the captures."""
        self.dismiss(None)

    @work(exclusive=True, group="verify")
    async def _verify(self) -> None:
        try:
            self._verdict.show(verdict_content(await asyncio.to_thread(verify, self._folder)))
        except SessionError as error:
            self._verdict.show(Content.styled(plain(str(error)), "$text-error"))

    @work(exclusive=True, group="command")
    async def action_command(self, name: str) -> None:
        """Do on the session what the command of that name does."""
        if self._open or self._busy:
            return
        self._busy = True
        self._said.show(f"$ brushloop {name} {self._folder}\n... at work")

        loop = asyncio.get_running_loop()

        def progress(what: str, done: int, total: int) -> None:
            loop.call_soon_threadsafe(self._show_progress, name, f"{what}: {done} of {total}")

        try:
            code, said = await asyncio.to_thread(run_command, name, self._folder, progress)
        finally:
            self._busy = False
        tail = "\n".join(plain(said).splitlines()[-MOST_LINES:])
        sign = "✓ done" if code == 0 else f"! exit code {code}"
        self._said.show(f"$ brushloop {name} {self._folder}\n{tail}\n{sign}")
        # The last line names the report; what is above can be scrolled to.
        self.call_after_refresh(self.query_one(VerticalScroll).scroll_end, animate=False)

    def _show_progress(self, name: str, line: str) -> None:
        if self.is_attached and self._busy:
            self._said.show(f"$ brushloop {name} {self._folder}\n... {plain(line)}")

    def _next_content(self) -> Content:
        if self._open:
            return Content(
                "The session is open. The same `brushloop collect` finishes it, merges it, and reads it back;\n"
                f"`brushloop sessions close {self._folder}` ends it as it is.\nescape  back"
            )
        keys = [
            ("c", f"brushloop calibrate {self._folder}"),
            ("t", f"brushloop fit {self._folder}"),
            ("w", f"brushloop validate {self._folder}  (report)"),
            ("escape", "back"),
        ]
        return Content("\n").join(Content.assemble((key, "bold $text-accent"), f"  {what}") for key, what in keys)


def verify(folder: Path) -> Verdict:
    """Read every file of a session again. Raises `InputError`."""
    from brushloop.sessions.verify import verify_session

    return verify_session(folder)


def run_command(name: str, folder: Path, progress: Progress) -> tuple[int, str]:
    """Calibrate, fit or validate the session, which may take minutes; return exit code and output."""
    try:
        return 0, text_of(_result(name, folder, progress).lines(), COLUMNS).strip()
    except Exception as error:  # the screen shows it, whatever it is, and stays
        code = getattr(error, "exit_code", None)
        return (1, "".join(format_exception(error))) if code is None else (code, str(error))


def _result(name: str, folder: Path, progress: Progress) -> Printable:
    if name == "calibrate":
        from brushloop.calibrate.calibrated import CalibrateRequest, calibrate_session

        return calibrate_session(CalibrateRequest(folder), progress)
    if name == "fit":
        from brushloop.calibrate.fit.brush import FitRequest, fit_presses

        return fit_presses(FitRequest(folder), progress)
    from brushloop.calibrate.validate.command import Request, validate

    return validate(Request(places=(str(folder),), command=f"brushloop validate {folder}"), progress)


def verdict_content(verdict: Verdict) -> Content:
    """Sound, or what is damaged."""
    read = f"{verdict.files} files, {verdict.strokes} strokes, {verdict.messages} messages read"
    if verdict.sound:
        return Content.assemble(("✓ sound", "bold $text-success"), f"  {verdict.session} ({verdict.state}): {read}")
    lines = [Content.styled(f"! damaged  {verdict.session}: try `brushloop sessions repair`", "bold $text-error")]
    lines += [Content(f"{file}: {plain('; '.join(problems))}") for file, problems in verdict.findings.items()]
    return Content("\n").join(lines)
