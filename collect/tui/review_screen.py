"""The review of a session: captures by cell, their pictures, marks and notes, and how alike the presses are."""

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

from brushloop.collect.tui.capture_screen import CaptureScreen
from brushloop.collect.tui.captures import CapturePictures, Review, ReviewCapture
from brushloop.collect.tui.finish_screen import FinishScreen
from brushloop.collect.tui.keys import LABELS
from brushloop.collect.tui.pictures import Pictures, binary_picture
from brushloop.collect.tui.text import SOFTWARE_STOP, condition_text, one_line, plain
from brushloop.collect.tui.widgets import KeyBar, Line, Rows, app_of
from brushloop.sessions.errors import SessionError
from brushloop.sessions.events import Remark
from brushloop.sessions.recording import add_remark, merged_file
from brushloop.sessions.records import Condition

KEYS = (
    ("escape", "back"),
    ("enter", "large"),
    ("b", "bad / good"),
    ("o", "note"),
    ("t", "copy MCAP time"),
    ("f", "finish"),
    ("?", "help"),
)
KEYS_AT_WORK = (("s", LABELS["s"]), *(pair for pair in KEYS if pair[0] not in ("o", "f")))
KEYS_S = 0.5
"""Interval at which the line of keys is updated, as a run may begin or end."""


class ReviewScreen(Screen[None]):
    """One session's captures. Remarks are appended to a file beside the recording, which never changes."""

    AUTO_FOCUS = "#captures"
    DEFAULT_CSS = """
    ReviewScreen #review-title { height: 1; padding: 0 1; background: $panel; text-style: bold; }
    ReviewScreen #review-body { height: 1fr; }
    ReviewScreen #captures { width: 34; height: 100%; border: none; padding: 0; }
    ReviewScreen #shown { width: 1fr; padding: 0 1; border-left: solid $foreground 40%; }
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
        """`at_work` says whether a run is in progress: then no text can be typed, because `s` stops the arm."""
        super().__init__()
        self._review = review
        self._made_by = pictures
        self._at_work = at_work
        self._now_ns = now_ns
        self._rows: tuple[ReviewCapture, ...] = ()
        self._capture: ReviewCapture | None = None
        self._pictures: CapturePictures | None = None
        self._alike: dict[Condition, tuple[float, int] | None] = {}
        self._title, self._words = Line("review-title"), Line("words")
        self._options = Rows("captures")
        self._photo, self._binary = pictures.make("review-photo"), pictures.make("review-binary")
        self._keys, self._stop_note = KeyBar(KEYS), Line("at-work")
        self._note = Input(placeholder="note, enter keeps it, escape leaves it", id="note-line", compact=True)

    def compose(self) -> ComposeResult:
        """Lay out the list, the pictures, the keys."""
        yield self._title
        yield self._stop_note
        with Horizontal(id="review-body"):
            yield self._options
            with Vertical(id="shown"):
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
        self._capture = self._rows[event.option_index]
        self._pictures = None
        self._show_words()
        self._load(self._capture)

    def on_option_list_option_selected(self, _event: OptionList.OptionSelected) -> None:
        """Show the capture under the cursor large."""
        if self._capture is not None:
            self._enlarge(self._capture)

    @work(exclusive=True, group="large")
    async def _enlarge(self, capture: ReviewCapture) -> None:
        try:
            large = await asyncio.to_thread(self._review.large, capture)
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        if self.is_active:
            app_of(self).push_screen(CaptureScreen(large, self._made_by, at_work=self._at_work()))

    def _show_keys(self) -> None:
        """Show the keys; during a run, show how to stop it, and hide note and finish."""
        at_work = self._at_work()
        self._keys.show(KEYS_AT_WORK if at_work else KEYS)
        self._stop_note.show(f"A run is in progress. {SOFTWARE_STOP}" if at_work else "")
        self.set_class(at_work, "-at-work")

    def action_back(self) -> None:
        """Leave the note, or the screen."""
        if self.has_class("-noting"):
            self.remove_class("-noting")
            self._options.focus()
        else:
            app_of(self).pop_screen()

    def action_mark(self) -> None:
        """Mark the capture bad, or good again."""
        if self._capture is not None and not self._capture.result.kept:
            self.notify(f"{self._capture.press.stroke_id}: the run did not count it; there is nothing to mark.")
        elif self._capture is not None:
            note = self._capture.remark.note if self._capture.remark is not None else ""
            bad = self._capture.counts
            self._remark(bad=bad, note=note)
            if bad and self._review.open:
                self.notify(f"{self._capture.press.stroke_id}: pressed again after the planned strokes")

    def action_note(self) -> None:
        """Let the operator type a note."""
        if self._capture is None:
            return
        if self._at_work():
            self.notify("Notes can be written after the run: until then, s stops the arm.", severity="warning")
            return
        self._note.value = self._capture.remark.note if self._capture.remark is not None else ""
        self.add_class("-noting")
        self._note.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Keep the note."""
        if self._capture is not None:
            self._remark(bad=self._capture.remark is not None and self._capture.remark.bad, note=event.value)
        self.action_back()

    def action_time(self) -> None:
        """Copy the time to jump to in a viewer."""
        if self._pictures is not None:
            app_of(self).copy_to_clipboard(f"{self._pictures.log_ns / 1e9:.9f}")
            self.notify(f"{self._pictures.log_ns / 1e9:.9f} s copied: log time of the still in the MCAP")

    def action_finish(self) -> None:
        """Show whether the recording is sound, and what comes next."""
        if self._at_work():
            self.notify("The run is in progress; finish once it is over.", severity="warning")
            return
        app_of(self).push_screen(FinishScreen(self._review.folder, is_open=self._review.open))

    def _remark(self, *, bad: bool, note: str) -> None:
        capture = self._capture
        if capture is None:
            return
        try:
            add_remark(
                self._review.folder,
                Remark(
                    t_ns=self._now_ns(),
                    still=capture.result.still,
                    stroke_id=capture.press.stroke_id,
                    bad=bad,
                    note=note,
                ),
            )
            self._review.read()
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        self._alike.pop(capture.press.condition, None)
        self._list(self._options.highlighted or 0)

    def _list(self, at: int) -> None:
        self._rows = tuple(
            sorted(self._review.captures, key=lambda c: (c.press.condition, c.press.stroke_id, c.result.still))
        )
        good = sum(row.counts for row in self._rows)
        state = "open" if self._review.open else "closed"
        self._title.show(f"Review   {one_line(self._review.folder.name)} ({state})   {good} of {len(self._rows)} count")
        self._options.fill([(None, _row_content(row)) for row in self._rows])
        if self._rows:
            self._options.highlighted = min(at, len(self._rows) - 1)
        else:
            self._words.show("no captures yet")

    def _show_words(self) -> None:
        if self._capture is not None:
            self._words.show(_words(self._capture, self._pictures, self._alike, self._review))

    @work(exclusive=True, group="look")
    async def _load(self, capture: ReviewCapture) -> None:
        """Show its pictures, then how alike the presses of its cell are; both are made off the screen's loop."""
        try:
            self._pictures = await asyncio.to_thread(self._review.pictures, capture)
            self._photo.show(self._pictures.photo)
            self._binary.show(None if self._pictures.binary is None else binary_picture(self._pictures.binary))
            self._show_words()
            asked = capture.press.condition
            if asked not in self._alike:
                self._alike[asked] = await asyncio.to_thread(self._review.repeatability, asked)
                self._show_words()
        except SessionError as error:
            self._words.show(Content.styled(plain(str(error)), "$text-error"))


def _row_content(capture: ReviewCapture) -> Content:
    sign, style = ("✓", "") if capture.counts else ("!", "bold $text-warning")
    noted = " ✎" if capture.remark is not None and capture.remark.note else ""
    waited = " dip?" if capture.unlike else ""
    return Content.assemble(
        (sign, style), f" {one_line(capture.press.stroke_id)}{noted}", (waited, "bold $text-warning")
    )


def _words(
    capture: ReviewCapture,
    pictures: CapturePictures | None,
    alike: dict[Condition, tuple[float, int] | None],
    review: Review,
) -> Content:
    why = ""
    result, press = capture.result, capture.press
    if not result.kept:
        why = f"  not counted by the run{f': {result.verdict}' if result.verdict else ''}"
    elif not capture.counts:
        why = "  marked bad"
    rows: list[tuple[str, str | tuple[str, str]]] = [
        ("MCAP", _where(capture, pictures, review.folder)),
        ("Repeats", _alike_text(alike, press.condition, review.not_compared)),
    ]
    if capture.unlike:
        rows.append(("Waited", (f"! {capture.unlike}", "bold $text-warning")))
    elif press.dip_to_touch_s is not None:
        rows.append(("Waited", f"{press.dip_to_touch_s:.1f} s from dip to touch"))
    if capture.remark is not None and capture.remark.note:
        rows.append(("Note", plain(capture.remark.note)))
    lines = [Content.assemble((press.stroke_id, "bold"), f"  {condition_text(press.condition)}", (why, "bold"))]
    lines += [Content.assemble((name.ljust(10), "dim"), text) for name, text in rows]
    return Content("\n").join(lines)


def _where(capture: ReviewCapture, pictures: CapturePictures | None, folder: Path) -> str:
    file = capture.file if (folder / capture.file).is_file() else merged_file(folder).name
    return f"{file}  still {capture.result.still}" + ("" if pictures is None else f"  at {pictures.log_ns / 1e9:.3f} s")


def _alike_text(alike: dict[Condition, tuple[float, int] | None], asked: Condition, not_compared: str) -> str:
    if not_compared:
        return f"not compared: {plain(not_compared)}"
    if asked not in alike:
        return "comparing ..."
    found = alike[asked]
    return "one press only" if found is None else f"mean CSIM {found[0]:.3f} of every pair of {found[1]} presses"
