"""Progress of long work and the time left: a bar on a terminal, elsewhere a few plain lines; all on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from brushloop.sessions.terminal import plain_console, say

if TYPE_CHECKING:
    from rich.progress import TaskID

Progress = Callable[[str, int, int], None]
"""Called with a description of the work, the number done and the total."""
T = TypeVar("T")
QUIET_S = 2.0
"""Without a terminal, shorter work prints nothing."""


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
        yield Lines(time.monotonic).update
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


class Lines:
    """Progress as lines: one for each tenth, and none within `QUIET_S` of the start or of the last."""

    def __init__(self, clock_s: Callable[[], float]) -> None:
        self._clock_s = clock_s
        self._began: dict[str, tuple[float, int]] = {}
        self._said: dict[str, int] = {}
        self._last_s = clock_s()

    def update(self, what: str, done: int, total: int) -> None:
        """See `Progress`."""
        now_s, tenth = self._clock_s(), 10 * done // max(total, 1)
        began_s, before = self._began.setdefault(what, (now_s, done))
        if now_s - self._last_s < QUIET_S or tenth <= self._said.get(what, 0):
            return
        self._last_s, self._said[what] = now_s, tenth
        line = f"{what}: {done} of {total}"
        if before < done < total:
            line += f", {left_text((now_s - began_s) / (done - before) * (total - done))}"
        say(line, err=True)


def left_text(seconds: float) -> str:
    """`about 40 s left`, or minutes where it is longer."""
    return f"about {seconds:.0f} s left" if seconds < 100 else f"about {seconds / 60:.0f} min left"
