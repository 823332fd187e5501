"""Looking through a session: captures by cell, their pictures, marks and notes, and how alike the presses are."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Input, OptionList

from collect.tui.captures import Looked, Review, Seen, counts
from collect.tui.finish import FinishScreen
from collect.tui.host import host
from collect.tui.keys import STOP_KEY, KeyBar
from collect.tui.line import Line
from collect.tui.pictures import Pictures, binary_picture
from collect.tui.rows import Rows
from collect.tui.text import SOFTWARE_STOP, one_line, plain
from sessions.errors import SessionError
from sessions.remarks import Remark, add_remark

KEYS = (
    ("escape", "back"),
    ("b", "bad / good"),
    ("o", "note"),
    ("t", "copy MCAP time"),
    ("f", "finish"),
    ("?", "help"),
)

KEYS_S = 0.5


class ReviewScreen(Screen[None]):
    """One session's captures. Remarks are appended beside the recording; nothing recorded changes."""

    AUTO_FOCUS = "#captures"
    DEFAULT_CSS = """
    ReviewScreen #review-title { height: 1; padding: 0 1; background: $panel; text-style: bold; }
    ReviewScreen #review-body { height: 1fr; }
    ReviewScreen #captures { width: 34; height: 100%; border: none; padding: 0; }
    ReviewScreen #looked { width: 1fr; padding: 0 1; border-left: solid $foreground 40%; }
    ReviewScreen #words { height: auto; }
    ReviewScreen #pictures { height: 1fr; }
    ReviewScreen #review-photo { margin-right: 1; }
    ReviewScreen #note-line { height: 1; border: none; padding: 0 1; display: none; }
    ReviewScreen.-noting #note-line { display: block; }
    ReviewScreen #at-work { height: 1; padding: 0 1; display: none; background: $warning; color: $text; }
    ReviewScreen.-at-work #at-work { display: block; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "back", "Back"),
        Binding("b", "mark", "Bad / good"),
        Binding("o", "note", "Note"),
        Binding("t", "time", "Copy MCAP time"),
        Binding("f", "finish", "Finish"),
    ]

    def __init__(
        self,
        review: Review,
        pictures: Pictures,
        *,
        at_work: Callable[[], bool] = lambda: False,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """`at_work` tells whether a run is on: then no text is typed, as `s` stops the arm."""
        super().__init__()
        self._review = review
        self._at_work = at_work
        self._now_ns = now_ns
        self._rows: tuple[Seen, ...] = ()
        self._seen: Seen | None = None
        self._looked: Looked | None = None
        self._alike: dict[tuple[float, float], tuple[float, int] | None] = {}
        self._title, self._words = Line("review-title"), Line("words")
        self._options = Rows("captures")
        self._photo, self._binary = pictures.make("review-photo"), pictures.make("review-binary")
        self._keys, self._stop_note = KeyBar(KEYS), Line("at-work")
        self._note = Input(placeholder="note, enter keeps it, escape leaves it", id="note-line", compact=True)

    def compose(self) -> ComposeResult:
        """The list, the pictures, the keys."""
        yield self._title
        yield self._stop_note
        with Horizontal(id="review-body"):
            yield self._options
            with Vertical(id="looked"):
                yield self._words
                with Horizontal(id="pictures"):
                    yield self._photo
                    yield self._binary
        yield self._note
        yield self._keys

    def on_mount(self) -> None:
        """List the captures, by cell and then by name."""
        self._list(0)
        self._show_keys()
        self.set_interval(KEYS_S, self._show_keys)

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Show the capture under the cursor."""
        self._seen = self._rows[event.option_index]
        self._looked = None
        self._show_words()
        self._load(self._seen)

    def _show_keys(self) -> None:
        """While a run is on, how to stop it; notes and the finish wait."""
        at_work = self._at_work()
        self._keys.show((STOP_KEY, *(pair for pair in KEYS if pair[0] not in ("o", "f"))) if at_work else KEYS)
        self._stop_note.show(f"The arm is at work. {SOFTWARE_STOP}" if at_work else "")
        self.set_class(at_work, "-at-work")

    def action_back(self) -> None:
        """Leave the note, or the screen."""
        if self.has_class("-noting"):
            self.remove_class("-noting")
            self._options.focus()
        else:
            host(self).pop_screen()

    def action_mark(self) -> None:
        """Bad, or good after all."""
        if self._seen is not None and not self._seen.kept:
            self.notify(f"{self._seen.stroke_id}: the run did not count it; there is nothing to mark.")
        elif self._seen is not None:
            note = self._seen.remark.note if self._seen.remark is not None else ""
            bad = counts(self._seen)
            self._say(bad=bad, note=note)
            if bad and self._review.open:
                self.notify(f"{self._seen.stroke_id}: pressed again once the plan is through")

    def action_note(self) -> None:
        """Type a note."""
        if self._seen is None:
            return
        if self._at_work():
            self.notify("Notes wait until the run is over: while the arm is at work, s stops it.", severity="warning")
            return
        self._note.value = self._seen.remark.note if self._seen.remark is not None else ""
        self.add_class("-noting")
        self._note.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Keep the note."""
        if self._seen is not None:
            self._say(bad=self._seen.remark is not None and self._seen.remark.bad, note=event.value)
        self.action_back()

    def action_time(self) -> None:
        """Where a viewer has to jump to."""
        if self._looked is not None:
            host(self).copy_to_clipboard(f"{self._looked.log_ns / 1e9:.9f}")
            self.notify(f"{self._looked.log_ns / 1e9:.9f} s copied: log time of the still in the MCAP")

    def action_finish(self) -> None:
        """Verify, then calibrate and report."""
        if self._at_work():
            self.notify("The run is on; finish once it is over.", severity="warning")
            return
        host(self).push_screen(FinishScreen(self._review.folder, is_open=self._review.open))

    def _say(self, *, bad: bool, note: str) -> None:
        seen = self._seen
        if seen is None:
            return
        try:
            add_remark(self._review.folder, Remark(seen.still, seen.stroke_id, bad, note, self._now_ns()))
            self._review.read()
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        self._alike.pop((seen.height_mm, seen.tilt_deg), None)
        self._list(self._options.highlighted or 0)

    def _list(self, at: int) -> None:
        self._rows = tuple(sorted(self._review.captures, key=lambda s: (s.height_mm, s.tilt_deg, s.stroke_id, s.still)))
        good = sum(map(counts, self._rows))
        state = "open" if self._review.open else "closed"
        self._title.show(f"Review   {one_line(self._review.folder.name)} ({state})   {good} of {len(self._rows)} count")
        self._options.fill([(None, _row_content(row)) for row in self._rows])
        if self._rows:
            self._options.highlighted = min(at, len(self._rows) - 1)
        else:
            self._words.show("no captures yet")

    def _show_words(self) -> None:
        if self._seen is not None:
            self._words.show(_words(self._seen, self._looked, self._alike, self._review))

    @work(exclusive=True, group="look")
    async def _load(self, seen: Seen) -> None:
        """Pictures first, then how alike the cell's presses are: both off the screen's loop."""
        try:
            self._looked = await asyncio.to_thread(self._review.look, seen)
            self._photo.show(self._looked.photo)
            self._binary.show(None if self._looked.binary is None else binary_picture(self._looked.binary))
            self._show_words()
            cell = (seen.height_mm, seen.tilt_deg)
            if cell not in self._alike:
                self._alike[cell] = await asyncio.to_thread(self._review.repeatability, *cell)
                self._show_words()
        except SessionError as error:
            self._words.show(Content.styled(plain(str(error)), "$text-error"))


def _row_content(seen: Seen) -> Content:
    sign, style = ("✓", "") if counts(seen) else ("!", "bold $text-warning")
    noted = " ✎" if seen.remark is not None and seen.remark.note else ""
    waited = " dip?" if seen.unlike else ""
    return Content.assemble((sign, style), f" {one_line(seen.stroke_id)}{noted}", (waited, "bold $text-warning"))


def _words(
    seen: Seen,
    looked: Looked | None,
    alike: dict[tuple[float, float], tuple[float, int] | None],
    review: Review,
) -> Content:
    why = ""
    if not seen.kept:
        why = f"  not counted by the run{f': {seen.verdict}' if seen.verdict else ''}"
    elif not counts(seen):
        why = "  marked bad"
    lines: list[Content] = [
        Content.assemble((seen.stroke_id, "bold"), f"  H {seen.height_mm:g} mm  α {seen.tilt_deg:g}°", (why, "bold")),
        Content.assemble(("MCAP      ", "dim"), _where(seen, looked, review.folder)),
        Content.assemble(("Repeats   ", "dim"), _alike_text(alike, (seen.height_mm, seen.tilt_deg), review.untold)),
    ]
    if seen.unlike:
        lines.append(Content.assemble(("Waited    ", "dim"), (f"! {seen.unlike}", "bold $text-warning")))
    elif seen.waited_s is not None:
        lines.append(Content.assemble(("Waited    ", "dim"), f"{seen.waited_s:.1f} s from dip to touch"))
    if seen.remark is not None and seen.remark.note:
        lines.append(Content.assemble(("Note      ", "dim"), plain(seen.remark.note)))
    return Content("\n").join(lines)


def _where(seen: Seen, looked: Looked | None, folder: Path) -> str:
    file = seen.file if (folder / seen.file).is_file() else f"{folder.name}.mcap"
    return f"{file}  still {seen.still}" + ("" if looked is None else f"  at {looked.log_ns / 1e9:.3f} s")


def _alike_text(
    alike: dict[tuple[float, float], tuple[float, int] | None], cell: tuple[float, float], untold: str
) -> str:
    if untold:
        return f"not compared: {plain(untold)}"
    if cell not in alike:
        return "comparing ..."
    found = alike[cell]
    return "one press only" if found is None else f"mean CSIM {found[0]:.3f} of every pair of {found[1]} presses"
