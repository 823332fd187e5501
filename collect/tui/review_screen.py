"""The review of a session: captures by condition, their pictures, marks and notes, and how alike the presses are."""

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
from textual.widgets import Footer, Input, OptionList

from brushloop.collect.tui.capture_screen import CaptureScreen
from brushloop.collect.tui.captures import CapturePictures, Review, ReviewCapture
from brushloop.collect.tui.pictures import Pictures, binary_picture
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    SOFTWARE_STOP,
    STOP,
    Line,
    Rows,
    app_of,
    condition_text,
    labelled,
    one_line,
    plain,
    trouble,
)
from brushloop.sessions.errors import SessionError
from brushloop.sessions.events import Remark
from brushloop.sessions.recording import add_remark, merged_file
from brushloop.sessions.records import Condition

AFTER_THE_RUN = ("note", "finish")
"""Actions of the review that wait until no run is in progress: in a note, `s` is a letter."""


class ReviewScreen(Screen[None]):
    """One session's captures. Remarks are appended to a file beside the recording, which never changes."""

    AUTO_FOCUS = "#captures"
    DEFAULT_CSS = """
    ReviewScreen #review-title { height: 1; padding: 0 1; background: $panel; text-style: bold; }
    ReviewScreen #captures { width: 34; height: 100%; border: none; padding: 0; }
    ReviewScreen #shown { width: 1fr; padding: 0 1; border-left: solid $foreground 40%; }
    ReviewScreen #words { height: auto; }
    ReviewScreen #review-photo { margin-right: 1; }
    ReviewScreen #note-line { height: 1; border: none; padding: 0 1; display: none; }
    ReviewScreen.-noting #note-line { display: block; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("escape", "back", "Back"),
        Binding("b", "mark", "Bad / good"),
        Binding("o", "note", "Note"),
        Binding("f", "finish", "Finish"),
        HELP_KEY,
    ]

    def __init__(
        self, review: Review, pictures: Pictures, finish: Callable[[Path], None], *, at_work: Callable[[], bool]
    ) -> None:
        """`finish` offers the next commands. `at_work` says whether a run is in progress: then no text can be typed,
        because `s` stops the arm."""
        super().__init__()
        self._review = review
        self._made_by = pictures
        self._finish, self._at_work = finish, at_work
        self._rows: tuple[ReviewCapture, ...] = ()
        self._capture: ReviewCapture | None = None
        self._pictures: CapturePictures | None = None
        self._alike: dict[Condition, tuple[float, int] | None] = {}
        self._title, self._words = Line("review-title"), Line("words")
        self._options = Rows("captures")
        self._photo, self._binary = pictures.make("review-photo"), pictures.make("review-binary")
        self._note = Input(placeholder="note, enter keeps it, escape leaves it", id="note-line", compact=True)

    def compose(self) -> ComposeResult:
        """Lay out the list, the pictures, the keys."""
        yield self._title
        with Horizontal():
            yield self._options
            with Vertical(id="shown"):
                yield self._words
                with Horizontal():
                    yield self._photo
                    yield self._binary
        yield self._note
        yield Footer(compact=True)

    def on_mount(self) -> None:
        """List the captures, by condition and then by name."""
        self._list(0)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Whether a key does something now."""
        if action in AFTER_THE_RUN:
            return not self._at_work()
        return super().check_action(action, parameters)

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Show the capture under the cursor."""
        self._capture, self._pictures = self._rows[event.option_index], None
        self._show_words()
        self._load(self._capture)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Show the capture under the cursor large, beside what the fitted brush predicts."""
        self._enlarge(self._rows[event.option_index])

    @work(exclusive=True, group="large")
    async def _enlarge(self, capture: ReviewCapture) -> None:
        try:
            large = await asyncio.to_thread(self._review.large, capture)
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        if self.is_active:
            app_of(self).push_screen(CaptureScreen(large, self._made_by))

    def action_back(self) -> None:
        """Leave the note, or the screen."""
        if self.has_class("-noting"):
            self.remove_class("-noting")
            self._options.focus()
        else:
            app_of(self).pop_screen()

    def action_mark(self) -> None:
        """Mark the capture bad, or good again."""
        capture = self._capture
        if capture is not None and not capture.result.kept:
            self.notify(f"{capture.press.stroke_id}: the run did not count it; there is nothing to mark.")
        elif capture is not None:
            bad = capture.counts
            self._remark(bad=bad, note="" if capture.remark is None else capture.remark.note)
            if bad and self._review.open:
                self.notify(f"{capture.press.stroke_id}: pressed again after the planned strokes")

    def action_note(self) -> None:
        """Let the operator type a note."""
        if self._capture is not None:
            self._note.value = "" if self._capture.remark is None else self._capture.remark.note
            self.add_class("-noting")
            self._note.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Keep the note."""
        if self._capture is not None:
            self._remark(bad=self._capture.remark is not None and self._capture.remark.bad, note=event.value)
        self.action_back()

    def action_finish(self) -> None:
        """Show what can be done with the session."""
        self._finish(self._review.folder)

    def _remark(self, *, bad: bool, note: str) -> None:
        capture = self._capture
        if capture is None:
            return
        still, stroke_id = capture.result.still, capture.press.stroke_id
        remark = Remark(t_ns=time.time_ns(), still=still, stroke_id=stroke_id, bad=bad, note=note)
        try:
            add_remark(self._review.folder, remark)
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
        state = f"open. {SOFTWARE_STOP}" if self._at_work() else "open" if self._review.open else "closed"
        self._title.show(f"{one_line(self._review.folder.name)}: {good} of {len(self._rows)} count; {state}")
        self._options.fill((_row_content(row) for row in self._rows), at)
        if not self._rows:
            self._words.show("no captures yet")

    def _show_words(self) -> None:
        if self._capture is not None:
            self._words.show(_words(self._capture, self._pictures, self._alike, self._review))

    @work(exclusive=True, group="look")
    async def _load(self, capture: ReviewCapture) -> None:
        """Show its pictures, then how alike the presses of its condition are; both are made off the screen's loop."""
        try:
            self._pictures = await asyncio.to_thread(self._review.pictures, capture)
            self._photo.show(self._pictures.photo)
            self._binary.show(binary_picture(self._pictures.binary))
            self._show_words()
            asked = capture.press.condition
            if asked not in self._alike:
                self._alike[asked] = await asyncio.to_thread(self._review.repeatability, asked)
                self._show_words()
        except SessionError as error:
            self._words.show(trouble(error))


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
    result, press = capture.result, capture.press
    why = "" if capture.counts else "  marked bad"
    if not result.kept:
        why = f"  not counted by the run{f': {result.verdict}' if result.verdict else ''}"
    file = capture.file if (review.folder / capture.file).is_file() else merged_file(review.folder).name
    when = "" if pictures is None else f"  at {pictures.log_ns / 1e9:.3f} s"
    lines = [
        Content.assemble((press.stroke_id, "bold"), f"  {condition_text(press.condition)}", (why, "bold")),
        labelled("MCAP", f"{file}  still {result.still}{when}"),
        labelled("Repeats", _alike_text(alike, press.condition, review.not_compared)),
    ]
    if capture.unlike:
        lines.append(labelled("Waited", Content.styled(f"! {capture.unlike}", "bold $text-warning")))
    elif press.dip_to_touch_s is not None:
        lines.append(labelled("Waited", f"{press.dip_to_touch_s:.1f} s from dip to touch"))
    if capture.remark is not None and capture.remark.note:
        lines.append(labelled("Note", plain(capture.remark.note)))
    return Content("\n").join(lines)


def _alike_text(alike: dict[Condition, tuple[float, int] | None], asked: Condition, not_compared: str) -> str:
    if not_compared:
        return f"not compared: {plain(not_compared)}"
    if asked not in alike:
        return "comparing ..."
    pairs = alike[asked]
    return "one press only" if pairs is None else f"mean CSIM {pairs[0]:.3f} of every pair of {pairs[1]} presses"
