"""The review of a session: captures by condition, their pictures, marks and notes, and how alike the presses are."""

from __future__ import annotations

import asyncio
import itertools
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Footer, OptionList

from brushloop.calibrate.artefact import FITS, current
from brushloop.calibrate.board.pix2len import SeenBoard, see_board
from brushloop.calibrate.compare import SHOWN_ROWS
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.command import BrushFit
from brushloop.calibrate.session import rig_of
from brushloop.calibrate.stats import odd_waits, waits_of
from brushloop.collect.engine.capture import mark_of, pictures_of
from brushloop.collect.engine.snapshot import LastCapture
from brushloop.collect.operator import Prompt
from brushloop.collect.photograph.checks import Verdict
from brushloop.collect.rig.paper import Patch
from brushloop.collect.tui.capture_screen import CaptureScreen
from brushloop.collect.tui.pictures import binary_picture, picture_widget
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    SOFTWARE_STOP,
    STOP,
    AskScreen,
    Bar,
    Line,
    Rows,
    app_of,
    condition_text,
    labelled,
    one_line,
    plain,
    trouble,
)
from brushloop.model.similarity import csim
from brushloop.sessions.disk import check_folder
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError
from brushloop.sessions.events import CaptureResult, Press, Remark
from brushloop.sessions.journal import JOURNAL_NAME, read_header, replay
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.recording import add_remark, merged_file, remarks_of
from brushloop.sessions.records import Condition, Quality, Stroke, Topic

MARKS_PER_ROW = 5


@dataclass(frozen=True, slots=True)
class ReviewCapture:
    """One capture of a session."""

    result: CaptureResult
    file: str
    marked_bad: bool = False
    """Whether a person marked it bad."""
    note: str = ""
    """What a person wrote about it."""
    unlike: str = ""
    """How its time from dip to touch differs from that of the session's other strokes; empty if it does not differ."""

    @property
    def press(self) -> Press:
        """The press in it."""
        return self.result.press

    @property
    def counts(self) -> bool:
        """Whether it counts: kept by the run, and not marked bad afterwards."""
        return self.result.kept and not self.marked_bad


class Review:
    """One session's folder, open or closed; reads it and writes nothing."""

    def __init__(self, folder: Path) -> None:
        """Raises `SessionDamaged`, and `InputError` if the session was not collected here, holds links, or does not say
        what its rig was."""
        self.folder = folder
        if not (folder / JOURNAL_NAME).is_file():
            raise InputError(folder, f"holds no {JOURNAL_NAME}: compare imported photographs with `validate`")
        check_folder(folder)
        self._board: SeenBoard | None = None
        self._pictures: dict[int, LastCapture] = {}
        # As the session recorded it: lens files lie beside the rig's own rig.toml, not beside its snapshot here.
        self._rig = rig_of(folder)
        self.read()

    def read(self) -> None:
        """Read the journal and the remarks again."""
        state, remarks = replay(self.folder / JOURNAL_NAME), remarks_of(self.folder)
        self.open, self.header = state.is_open, read_header(self.folder, state)
        odd, captures = odd_waits(waits_of(state)), list[ReviewCapture]()
        for step in state.files.values():
            if isinstance(result := step.result, CaptureResult):
                remark = remarks.get(result.still)
                bad, note = (False, "") if remark is None else (remark.bad, remark.note)
                captures.append(ReviewCapture(result, step.file, bad, note, odd.get(result.still, "")))
        self.captures = sorted(captures, key=lambda c: (c.press.condition, c.press.stroke_id, c.result.still))

    def pictures(self, capture: ReviewCapture) -> LastCapture:
        """A capture with its pictures, made once: the whole photograph where the board is not seen.

        Takes a tenth of a second: call it off a screen's loop. Raises `SessionDamaged` if the still is missing.
        """
        still = capture.result.still
        if still not in self._pictures:
            self._pictures[still] = self._make_pictures(capture)
        return self._pictures[still]

    def marks(self) -> NDArray[np.bool_] | None:
        """One mark of each condition as ink, `MARKS_PER_ROW` beside each other; None where no board was seen.

        Takes seconds: call it off a screen's loop. Raises `SessionDamaged` as `pictures` does.
        """
        shown = {capture.press.condition: capture for capture in self.captures if capture.counts}
        inks = [ink[SHOWN_ROWS] for at in sorted(shown) if (ink := self.pictures(shown[at]).binary) is not None]
        if not inks:
            return None
        inks += [np.zeros_like(inks[0])] * (-len(inks) % MARKS_PER_ROW)
        return np.vstack([np.hstack(inks[k : k + MARKS_PER_ROW]) for k in range(0, len(inks), MARKS_PER_ROW)])

    def repeatability(self, condition: Condition) -> str:
        """How alike the counted presses of one condition are, in words.

        CSIM is that of the validation, on the binarised 128 x 128 images in the millimetre alignment.
        """
        binaries = [
            pictures.binary.astype("float32")
            for capture in self.captures
            if capture.press.condition == condition and capture.counts
            if (pictures := self.pictures(capture)).binary is not None
        ]
        if len(binaries) < 2:
            return "one press only"
        alike = statistics.fmean(csim(a, b) for a, b in itertools.combinations(binaries, 2))
        return f"mean CSIM {100.0 * alike:.1f} % between pairs, from {len(binaries)} presses (identical: 100 %)"

    def predicted(self, capture: ReviewCapture) -> tuple[LastCapture, str]:
        """A capture with the mark that the session's fitted brush predicts, and which fit that is.

        Call it off a screen's loop. Raises `SessionDamaged` as `pictures` does.
        """
        pictures = self.pictures(capture)
        try:
            if (path := current(self.folder, FITS)) is None:
                return pictures, "no fit yet: run `brushloop fit`"
            fit = BrushFit.read(path)
        except InputError as error:
            return pictures, str(error)
        pictures = replace(pictures, model=mark_of(fit.press(), capture.press.condition))
        return pictures, f"CCD-BSM fitted to {fit.strokes} strokes of {fit.session_id}"

    def _make_pictures(self, capture: ReviewCapture) -> LastCapture:
        path, result = self.folder / capture.file, capture.result
        path = path if path.is_file() else merged_file(self.folder)
        image = stroke = verdict = None
        for _schema, channel, message in McapFile(path).sound().messages([Topic.STILL, Topic.STROKE, Topic.QUALITY]):
            if message.sequence != result.still:
                continue
            if channel.topic == Topic.STILL:
                image = decode_gray(decode_still(message.data, path), str(path))
            elif channel.topic == Topic.QUALITY:
                verdict = Verdict(Quality.model_validate_json(message.data).checks)
            else:
                stroke = Stroke.model_validate_json(message.data)
        if image is None:
            raise SessionDamaged(path, f"lacks photograph {result.still}")
        whole = LastCapture(result.press, result.still, result.kept, verdict, image)
        if stroke is None or stroke.cell_mm is None:
            return whole  # a take that does not count has no stroke record
        try:
            if self._rig.lens is not None:
                image = self._rig.lens.undistort(image)
            self._board = see_board(image, self._rig.board, self._board)
        except CalibrationError:
            if self._board is None:
                return whole
        photo, binary = pictures_of(image, self._board.plane, Patch(0, *stroke.cell_mm))
        return replace(whole, photo=photo, binary=binary)


class ReviewScreen(Screen[None]):
    """One session's captures. Remarks are appended to a file beside the recording, which never changes."""

    AUTO_FOCUS = "#captures"
    DEFAULT_CSS = """
    ReviewScreen #captures { width: 34; height: 100%; border: none; padding: 0; }
    ReviewScreen #shown { width: 1fr; padding: 0 1; border-left: solid $foreground 40%; }
    ReviewScreen #review-photo { margin-right: 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("escape", "app.pop_screen", "Back"),
        Binding("b", "mark", "Bad / good"),
        Binding("o", "note", "Note"),
        HELP_KEY,
    ]

    def __init__(self, review: Review, at_work: Callable[[], bool]) -> None:
        """`at_work` says whether a run is in progress."""
        super().__init__()
        self._review, self._at_work = review, at_work
        self._capture: ReviewCapture | None = None
        self._title, self._words = Bar("title"), Line("words")
        self._options = Rows("captures")
        self._photo, self._binary = picture_widget("review-photo"), picture_widget("review-binary")

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
        yield Footer(compact=True)

    def on_mount(self) -> None:
        """List the captures, by condition and then by name."""
        self._list(0)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Notes wait until no run is in progress: until then `s` stops the arm."""
        if action == "note":
            return not self._at_work()
        return super().check_action(action, parameters)

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        """Show the capture under the cursor."""
        self._capture = self._review.captures[event.option_index]
        self._show_words(self._capture)
        self._load(self._capture)

    @work(exclusive=True, group="large")
    async def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Show the capture under the cursor large, beside what the fitted brush predicts."""
        try:
            large = await asyncio.to_thread(self._review.predicted, self._review.captures[event.option_index])
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        if self.is_active:
            app_of(self).push_screen(CaptureScreen(*large))

    def action_mark(self) -> None:
        """Mark the capture bad, or good again."""
        capture = self._capture
        if capture is not None and not capture.result.kept:
            self.notify(f"{capture.press.stroke_id} did not count in the run, so it cannot be marked.")
        elif capture is not None:
            self._remark(capture, bad=capture.counts, note=capture.note)
            if capture.counts and self._review.open:
                self.notify(f"{capture.press.stroke_id} is pressed again after the planned strokes")

    def action_note(self) -> None:
        """Let the operator type a note."""
        if (capture := self._capture) is not None:

            def answered(note: str | None) -> None:
                # Not the capture of when the key was pressed: a mark may have been kept since.
                if note is not None and self._capture is not None:
                    self._remark(self._capture, bad=self._capture.marked_bad, note=note)

            question = f"Note on {capture.press.stroke_id}. Enter keeps it, escape changes nothing."
            app_of(self).push_screen(AskScreen(Prompt(question, default=capture.note, read=str)), answered)

    def _remark(self, capture: ReviewCapture, *, bad: bool, note: str) -> None:
        still, stroke_id = capture.result.still, capture.press.stroke_id
        remark = Remark(t_ns=time.time_ns(), still=still, stroke_id=stroke_id, bad=bad, note=note)
        try:
            add_remark(self._review.folder, remark)
            self._review.read()
        except SessionError as error:
            self.notify(plain(str(error)), severity="error")
            return
        at = self._options.highlighted or 0
        self._capture = self._review.captures[at]
        self._list(at)

    def _list(self, at: int) -> None:
        review, captures = self._review, self._review.captures
        good = sum(capture.counts for capture in captures)
        state = f"open. {SOFTWARE_STOP}" if self._at_work() else "open" if review.open else "closed"
        self._title.show(f"{one_line(review.folder.name)}: {good} of {len(captures)} count; {state}")
        self._options.fill(map(_row_content, captures), at)
        if not captures:
            self._words.show("no captures yet")

    @work(exclusive=True, group="look")
    async def _load(self, capture: ReviewCapture) -> None:
        """Show its pictures, then how alike the presses of its condition are; both are made off the screen's loop."""
        try:
            pictures = await asyncio.to_thread(self._review.pictures, capture)
            self._photo.show(pictures.photo)
            self._binary.show(binary_picture(pictures.binary))
            self._show_words(capture, await asyncio.to_thread(self._review.repeatability, capture.press.condition))
        except SessionError as error:
            self._words.show(trouble(error))

    def _show_words(self, capture: ReviewCapture, alike: str = "...") -> None:
        result, press, folder = capture.result, capture.press, self._review.folder
        why = "  marked bad" if capture.marked_bad else ""
        if not result.kept:
            why = f"  not counted by the run: {result.verdict or 'as requested'}"
        file = capture.file if (folder / capture.file).is_file() else merged_file(folder).name
        lines = [
            Content.assemble((press.stroke_id, "bold"), f"  {condition_text(press.condition)}", (why, "bold")),
            labelled("MCAP", f"{file}, photograph {result.still}"),
            labelled("Repeats", alike),
        ]
        if capture.unlike:
            lines.append(labelled("Waited", Content.styled(f"! {capture.unlike}", "bold $text-warning")))
        elif press.dip_to_touch_s is not None:
            lines.append(labelled("Waited", f"{press.dip_to_touch_s:.1f} s from dip to touch"))
        if capture.note:
            lines.append(labelled("Note", plain(capture.note)))
        self._words.show(Content("\n").join(lines))


def _row_content(capture: ReviewCapture) -> Content:
    sign, style = ("✓", "") if capture.counts else ("!", "bold $text-warning")
    noted, waited = " ✎" if capture.note else "", " waited?" if capture.unlike else ""
    name = f" {one_line(capture.press.stroke_id)}{noted}"
    return Content.assemble((sign, style), name, (waited, "bold $text-warning"))
