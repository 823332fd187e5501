"""Print to a terminal, where control characters in text from files, names or devices are shown, never executed.

The progress of long work is a bar on stderr, where that is a terminal.
"""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

import typer

if TYPE_CHECKING:
    from rich.console import Console  # noqa: TID251 - the one place
    from rich.progress import TaskID

Progress = Callable[[str, int, int], None]
"""Called with a description of the work, the number done and the total."""
T = TypeVar("T")
_ACTED_ON = re.compile(
    # Control characters of ASCII and Latin-1 (an escape sequence begins with one), except the tab.
    "[\x00-\x08\x0a-\x1f\x7f-\x9f"
    # Marks that turn the direction of writing, break lines or have no width; surrogates, from undecodable names.
    "\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff\U000e0000-\U000e007f]"
)


def plain(text: str, *, keep: str = "") -> str:
    r"""Escape every character that a terminal acts on, as `\u001b`: a JSON string keeps its value.

    Line ends are escaped as well, so that a name cannot fake a new line. `keep` lists characters left as they are.
    """
    return _ACTED_ON.sub(lambda found: found[0] if found[0] in keep else _escaped(found[0]), text)


def inert(text: str) -> str:
    """Remove those characters, for places with a fixed layout: they have no width."""
    return text if text.isprintable() else _ACTED_ON.sub("", text)


def say(*parts: object, err: bool = False) -> None:
    """Print each part: a string as one line, anything else (a table) as rich lays it out, without markup.

    A terminal shows a long line broken between words, but commands (`$ ...`) and JSON as they are, to be copied.
    """
    stream = sys.stderr if err else sys.stdout  # None where it is closed
    wide = shutil.get_terminal_size().columns if stream and stream.isatty() else sys.maxsize
    for part in parts:
        if not isinstance(part, str):
            plain_console(stderr=err).print(part)
            continue
        if len(line := plain(part)) > wide and not line.startswith(("$ ", "{")):
            line = textwrap.fill(line, wide, break_long_words=False, break_on_hyphens=False)
        typer.echo(line, err=err)  # noqa: TID251 - the one place


def text_of(parts: Iterable[object], columns: int) -> str:
    """Lay lines and tables out as plain text, for a page of that width."""
    with (console := plain_console(columns=columns)).capture() as captured:
        for part in parts:
            console.print(part, soft_wrap=isinstance(part, str))
    return captured.get()


def plain_console(*, stderr: bool = False, columns: int | None = None) -> Console:
    """Make a rich console for tables and progress bars: no markup, and no control character but the console's own.

    A colour is given as a style; with `columns` there is none. Rich is imported here because `--help` does without it.
    """
    from rich.console import Console  # noqa: TID251 - the one place
    from rich.segment import Segment

    class PlainConsole(Console):
        def on_broken_pipe(self) -> None:
            raise  # rich would exit with the code of a defect

        def _render_buffer(self, buffer: Iterable[Segment]) -> str:
            return super()._render_buffer(
                part if part.control else Segment(plain(part.text, keep="\n"), part.style) for part in buffer
            )

    colours = None if columns is None else False
    return PlainConsole(stderr=stderr, markup=False, emoji=False, width=columns, force_terminal=colours)


def _escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))


def unseen(_what: str, _done: int, _total: int) -> None:
    """Ignore progress."""


def counted(items: Iterable[T], what: str, total: int, progress: Progress) -> Iterator[T]:
    """Yield the items; each is reported once the caller asks for the next."""
    progress(what, 0, total)
    for done, item in enumerate(items, 1):
        yield item
        progress(what, done, total)


@contextmanager
def shown() -> Generator[Progress]:
    """Show progress until the end of the block."""
    if not sys.stderr.isatty():
        yield unseen
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=plain_console(stderr=True), transient=True) as bar:
        tasks: dict[str, TaskID] = {}

        def update(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done)

        yield update
