"""The card at the end of a session: its marks, strokes and time, how alike the presses are, and what comes next."""

from __future__ import annotations

import asyncio
import statistics
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.content import Content
from textual.screen import ModalScreen

from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.headless import minutes_text
from brushloop.collect.tui.pictures import Pictures, binary_picture
from brushloop.collect.tui.text import one_line, plain
from brushloop.collect.tui.widgets import Line
from brushloop.sessions.errors import SessionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from brushloop.sessions.records import Condition

LABEL = 15
MARGIN_PX = 4
KEYS = (("v", "look through the captures"), ("f", "check, calibrate, fit, report"), ("q", "leave"), ("escape", "back"))


class EndScreen(ModalScreen[str]):
    """Shown once a session is complete. Answers `review`, `finish`, or nothing."""

    DEFAULT_CSS = """
    EndScreen { align: center middle; }
    EndScreen Vertical {
        width: 90%; max-width: 100; height: auto; max-height: 95%; padding: 1 2;
        border: heavy $success; border-title-style: bold; background: $surface;
    }
    EndScreen #end-marks { height: 10; margin-bottom: 1; }
    EndScreen Line { height: auto; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("v", "dismiss('review')", "Review"),
        Binding("f", "dismiss('finish')", "Finish"),
        Binding("q", "app.quit", "Leave"),
        Binding("escape,enter", "dismiss('')", "Back"),
    ]

    def __init__(self, now: Snapshot, pictures: Pictures) -> None:
        super().__init__()
        self._now = now
        self._marks = pictures.make("end-marks")
        self._counts, self._alike, self._next = Line("end-counts"), Line("end-alike"), Line("end-next")

    def compose(self) -> ComposeResult:
        """Lay out marks, figures, and what comes next."""
        with Vertical() as card:
            card.border_title = f"{one_line(self._now.session_id)} is complete"
            yield self._marks
            yield self._counts
            yield self._alike
            yield self._next

    def on_mount(self) -> None:
        """Show what is known; begin to compare the presses."""
        self._counts.show(counts_content(self._now))
        self._next.show(_next_content(Path(self._now.folder)))
        self._show_alike("reading the photographs ...")
        self._measure()

    def _show_alike(self, text: str) -> None:
        self._alike.show(_row("Repeatability", text))

    @work(exclusive=True, group="measure")
    async def _measure(self) -> None:
        from brushloop.collect.tui.captures import Review

        try:
            review = await asyncio.to_thread(Review, Path(self._now.folder))
            first = {c.press.condition: c for c in reversed(review.captures) if c.counts}
            marks: dict[Condition, NDArray[np.bool_]] = {}
            alike: list[tuple[float, int]] = []
            for number, asked in enumerate(sorted(first), 1):
                self._show_alike(f"comparing, cell {number} of {len(first)} ...")
                pictures = await asyncio.to_thread(review.pictures, first[asked])
                if pictures.binary is not None:
                    marks[asked] = pictures.binary
                    self._marks.show(binary_picture(contact_sheet(marks)))
                if (found := await asyncio.to_thread(review.repeatability, asked)) is not None:
                    alike.append(found)
        except SessionError as error:
            self._show_alike(plain(str(error)))
            return
        self._show_alike(plain(review.not_compared) or alike_text(alike))


def counts_content(now: Snapshot) -> Content:
    """Strokes, time, retakes, what was cut short."""
    retakes = sum(cell.bad for cell in now.grid)
    rows = [
        ("Strokes", f"{now.strokes_done} of {now.strokes_planned}"),
        ("Time", f"{minutes_text(now.elapsed_s)} since the start, or since the last resume"),
        ("Retakes", f"{retakes}" + (f", {now.given_up} strokes left out" if now.given_up else "")),
        ("Source", one_line(now.source)),
    ]
    if now.voids:
        rows.insert(3, ("Cut short", f"{now.voids}, made again"))
    return Content("\n").join(_row(name, text) for name, text in rows)


def alike_text(cells: list[tuple[float, int]]) -> str:
    """`mean CSIM 0.914 of 45 presses in 15 cells`: each (mean of a cell's pairs, its presses) counts once."""
    if not cells:
        return "no cell was pressed twice"
    presses, where = sum(count for _, count in cells), "cell" if len(cells) == 1 else "cells"
    return f"mean CSIM {statistics.fmean(mean for mean, _ in cells):.3f} of {presses} presses in {len(cells)} {where}"


def contact_sheet(marks: dict[Condition, NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """One mark of each cell, depths from left to right and tilts downward, all cut to where any has ink."""
    import numpy as np

    depths_mm, tilts_deg = sorted({asked.depth_mm for asked in marks}), sorted({asked.tilt_deg for asked in marks})
    any_ink = np.logical_or.reduce(list(marks.values()))
    if not any_ink.any():
        return any_ink
    rows, columns = np.flatnonzero(any_ink.any(axis=1)), np.flatnonzero(any_ink.any(axis=0))
    cut = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    high, wide = rows[-1] + 1 - rows[0] + 2 * MARGIN_PX, columns[-1] + 1 - columns[0] + 2 * MARGIN_PX
    sheet = np.zeros((high * len(tilts_deg), wide * len(depths_mm)), np.bool_)
    for asked, mark in marks.items():
        top = high * tilts_deg.index(asked.tilt_deg) + MARGIN_PX
        left = wide * depths_mm.index(asked.depth_mm) + MARGIN_PX
        ink = mark[cut]
        sheet[top : top + ink.shape[0], left : left + ink.shape[1]] = ink
    return sheet


def _next_content(folder: Path) -> Content:
    """The next command, and the keys."""
    keys = Content("\n").join(Content.assemble((f"{key:<{LABEL}}", "bold $text-accent"), what) for key, what in KEYS)
    return Content("\n").join((_row("Next", f"brushloop calibrate {plain(str(folder))}"), Content(""), keys))


def _row(name: str, text: str) -> Content:
    return Content.assemble((name.ljust(LABEL), "dim"), text)
