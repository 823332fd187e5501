"""A terminal that may be lost (a closed window, a dropped ssh connection), and that no displayed text can control.

textual's own driver waits for ever once the terminal is gone: the first failed write ends its writer thread, and
SIGCONT, which comes with every hang-up, starts a second set of threads that nothing ends.
"""

from __future__ import annotations

import contextlib
import io
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import TextIO

from rich.segment import Segment
from textual import events
from textual.app import App
from textual.color import Color
from textual.drivers.linux_driver import LinuxDriver
from textual.filter import LineFilter
from textual.widgets import HelpPanel

from brushloop.sessions.terminal import inert, plain

STOP_KEYS = frozenset({"s", "ctrl+c"})
STOP_SHOWN_S = 5.0


class TerminalDriver(LinuxDriver):
    """textual's driver without its two ways to hang."""

    _suspended = False

    def start_application_mode(self) -> None:
        """Take the terminal."""
        self._file = _LostWrites(self._file)
        super().start_application_mode()

    def suspend_application_mode(self) -> None:
        """Hand the terminal back for a while."""
        self._suspended = True
        super().suspend_application_mode()

    def resume_application_mode(self) -> None:
        """Take it again, but only after handing it back."""
        if self._suspended:
            self._suspended = False
            super().resume_application_mode()


class PlainApp(App[None]):
    """An app that shows text of any origin without letting it control the terminal, and takes stop keys first."""

    TITLE = "brushloop"
    ENABLE_COMMAND_PALETTE = False
    # Where a notification covers neither tip and force of a run, nor the last lines.
    CSS = "ToastRack { dock: top; align: right top; margin-top: 8; }"
    # From 110 columns on, a picture has room beside the text.
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (110, "-wide")]  # noqa: RUF012 - so textual declares it
    # A selection would be copied with ctrl+c, which is a stop key here.
    ALLOW_SELECT = False

    def __init__(self) -> None:
        super().__init__(driver_class=TerminalDriver)

    async def on_event(self, event: events.Event) -> None:
        """Handle stop keys before textual, which would give a letter to a field that takes text."""
        if isinstance(event, events.Key) and event.key in STOP_KEYS and self.stops(event):
            self.action_stop()
            return
        await super().on_event(event)

    def stops(self, event: events.Key) -> bool:
        """Whether this stop key stops the arm now."""
        return bool(self.check_action("stop", ()))

    def action_stop(self) -> None:
        """Show that a stop was sent, on every screen; an app sends it first."""
        self.notify("Red button if it moves.", title="STOP SENT", severity="warning", timeout=STOP_SHOWN_S)

    def action_help(self) -> None:
        """Show or hide textual's list of the keys of this screen."""
        (self.action_hide_help_panel if self.screen.query(HelpPanel) else self.action_show_help_panel)()

    def run_command(self, *words: str) -> None:
        """Hand the terminal to a command of brushloop, which may take minutes, and come back on Enter.

        Ctrl-c ends the command, not the screen.
        """
        with self.suspend():
            # A handler, not SIG_IGN, which the command would inherit.
            before = signal.signal(signal.SIGINT, lambda _number, _frame: None)
            try:
                sys.stdout.write(f"$ brushloop {plain(' '.join(words))}\n")
                sys.stdout.flush()
                code = subprocess.run([sys.executable, "-m", "brushloop", *words], check=False).returncode
                sys.stdout.write(f"{f'exit code {code}' if code else 'done'}. Enter: back to the screen\n")
                sys.stdout.flush()
                sys.stdin.readline()
            finally:
                signal.signal(signal.SIGINT, before)

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Add `PlainLines` after textual's own filters."""
        return [*super().get_line_filters(), PLAIN_LINES]


class PlainLines(LineFilter):
    """Removes characters that control a terminal from all text; textual's own controls stay."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Filter one line."""
        return [part if part.control else Segment(inert(part.text), part.style) for part in segments]


PLAIN_LINES = PlainLines()
"""The same object each time: for another one, textual would draw every line again."""


class _LostWrites(io.StringIO):
    """A file that ignores failed writes: those to a terminal that is gone."""

    def __init__(self, file: TextIO) -> None:
        super().__init__()
        self._terminal = file

    def fileno(self) -> int:
        return self._terminal.fileno()

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._terminal.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._terminal.flush()
