"""A terminal that may be lost (a closed window, a dropped ssh connection), and that no displayed text can control.

textual's own driver waits for ever once the terminal is gone: the first failed write ends its writer thread, and
SIGCONT, which comes with every hang-up, starts a second set of threads that nothing ends.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TextIO

from rich.segment import Segment
from textual.app import App, SystemCommand
from textual.color import Color
from textual.drivers.linux_driver import LinuxDriver
from textual.filter import LineFilter
from textual.screen import Screen
from textual.theme import BUILTIN_THEMES

from brushloop.sessions.terminal import inert

DARK = "textual-dark"
MAX_BYTES = 64


def theme_file() -> Path:
    """Where the choice of colours is kept for the next start."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "brushloop" / "theme"


def chosen_theme(file: Path | None) -> str:
    """The theme that was chosen last; dark where none was, or where the file holds anything else."""
    if file is None:
        return DARK
    try:
        with file.open("rb") as stream:
            name = stream.read(MAX_BYTES).decode("ascii", "replace").strip()
    except OSError:
        return DARK
    return name if name in BUILTIN_THEMES else DARK


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
    """An app that shows text of any origin without letting it control the terminal, in the colours that were chosen."""

    def __init__(self, theme_file: Path | None = None) -> None:
        """`theme_file` keeps the choice of colours; None where it is not kept."""
        super().__init__(driver_class=TerminalDriver)
        self._theme_file = theme_file
        self.theme = chosen_theme(theme_file)

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """Only the choice of colours: textual's own way to quit would leave a moving arm."""
        yield SystemCommand("Colours", "Choose dark, light or other colours", self.action_change_theme)

    def watch_theme(self, name: str) -> None:
        """Keep a choice; where the folder cannot be written, it holds until the program ends."""
        if self._theme_file is not None and name != chosen_theme(self._theme_file):
            with contextlib.suppress(OSError):
                self._theme_file.parent.mkdir(parents=True, exist_ok=True)
                self._theme_file.write_text(f"{name}\n", encoding="ascii")

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Add `PlainLines` after textual's own filters."""
        return [*super().get_line_filters(), PLAIN_LINES]


class PlainLines(LineFilter):
    """Removes characters that control a terminal from all text; textual's own controls stay."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Filter one line."""
        return [part if part.control else Segment(inert(part.text), part.style) for part in segments]


PLAIN_LINES = PlainLines()


class _LostWrites(io.StringIO):
    """A file that ignores failed writes: those to a terminal that is gone."""

    def __init__(self, file: TextIO) -> None:
        super().__init__()
        self._terminal = file

    def fileno(self) -> int:
        return self._terminal.fileno()

    def isatty(self) -> bool:
        return self._terminal.isatty()

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._terminal.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._terminal.flush()
