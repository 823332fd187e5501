"""The run screen: one `Snapshot` after the other, from the first retreat to the end of the run."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.reactive import reactive
from textual.screen import Screen
from textual.widgets import DataTable, Footer

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.snapshot import (
    ConditionCount,
    Mark,
    SheetMap,
    Snapshot,
    eta_text,
    minutes_text,
    no_pose_text,
)
from brushloop.collect.operator import OperatorRequest
from brushloop.collect.tui.capture_screen import CaptureScreen, checks_content
from brushloop.collect.tui.pictures import binary_picture, picture_widget
from brushloop.collect.tui.so_far import ModelByNow
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    SHORT_STOP,
    SOFTWARE_STOP,
    STOP,
    Bar,
    Line,
    Newest,
    app_of,
    condition_text,
    labelled,
    one_line,
    plain,
)
from brushloop.sessions.errors import SessionError
from brushloop.sessions.recording import mark_bad_or_good
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from brushloop.collect.engine.engine import Engine
    from brushloop.collect.engine.snapshot import LastCapture

OVER = "Over: q leaves"
GOES_ON = "Press enter to resume, or run the same command later."
COMMAND_GOES_ON = "Run the same command again to continue."
WARNING = "warning: "
PANES = ("overview", "capture", "camera")
GRID_STYLES = {"▶": "bold reverse", "×": "bold red", "!": "bold yellow", "✓": "bold green", "›": "bold", "": "dim"}
SHEET_SIGNS: dict[Mark | None, tuple[str, str]] = {
    None: ("·", "dim"),
    Mark.NOW: ("▶", "bold reverse"),
    Mark.WAITING: ("●", "bold"),
    Mark.KEPT: ("●", "$text-success"),
    Mark.BAD: ("!", "bold $text-warning"),
    Mark.VOID: ("×", "bold $text-error"),
    Mark.CHECK: ("△", "dim"),
}
SHARP_PX = 2.0
"""Blur in the full frame below which the lens is in focus: a hint for turning it; the step's own check decides."""
BLACK_LEVEL = 40
"""Brightest pixel, of 255, of a picture that counts as black: the noise of a camera stays below."""
EIGHTHS = " ▁▂▃▄▅▆▇█"
LEAST_SCALE_N = 0.1
"""Smallest full scale of that drawing, so that noise is not stretched: a soft brush pushes with a few tens of mN."""
LOG_LINES = 200
"""Newest lines of the log that are shown."""
BOUNCE_S = 0.7
"""Time after an answer in which the keys of requests do nothing: pressing an answer's key twice sends no request."""


class RunScreen(Screen[None], inherit_bindings=False):
    """Draws snapshots; keeps only what is on the screen."""

    AUTO_FOCUS = "#log-pane"
    HELP = """
Grid: ✓ complete, ▶ now, › next, ! has takes that do not count, × left out

Sheet: · blank, ● counts, ! does not count, × cut short, △ self-check
"""
    DEFAULT_CSS = """
    RunScreen #band { height: 7; }
    RunScreen #state {
        width: 18; height: 7; margin: 0 1; content-align: center middle; text-align: center; text-style: bold;
        background: $panel; color: $text;
    }
    RunScreen #state.-running { background: $success; }
    RunScreen #state.-recovering, RunScreen #state.-pausing, RunScreen #state.-stopping, RunScreen #state.-asking {
        background: $warning;
    }
    RunScreen #state.-paused { background: $primary; }
    RunScreen #state.-done { background: $success-darken-2; }
    RunScreen #state.-stopped, RunScreen #state.-failed, RunScreen #state.-silent { background: $error; }
    RunScreen #figures { width: 1fr; height: 7; text-wrap: nowrap; text-overflow: ellipsis; }
    RunScreen .pane {
        border-top: solid $foreground 40%; border-title-style: bold; border-title-color: $foreground; padding: 0 1;
    }
    RunScreen #why-pane { display: none; height: auto; max-height: 60%; border: heavy $error; padding: 0 1; }
    RunScreen.-wrong #why-pane { display: block; }
    RunScreen #right { width: 45%; }
    RunScreen #top { height: auto; max-height: 70%; }
    RunScreen #grid { width: 1fr; height: auto; max-height: 100%; }
    RunScreen #sheet { width: auto; max-width: 40%; height: auto; min-width: 18; }
    RunScreen.-narrow.-wrong #sheet { display: none; }
    RunScreen #capture-words { height: auto; max-height: 50%; }
    RunScreen #capture-pictures { height: 1fr; min-height: 4; }
    RunScreen.-narrow #right { display: none; }
    RunScreen.-narrow.-capture #right, RunScreen.-narrow.-camera #right { display: block; width: 1fr; }
    RunScreen.-narrow.-capture #left, RunScreen.-narrow.-camera #left { display: none; }
    RunScreen.-narrow.-capture #camera, RunScreen.-narrow.-camera #capture { display: none; }
    """
    # Most important first: a narrow screen shows only as many as fit.
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("space,p", "pause", "Pause", tooltip="before the next step"),
        Binding("space,p", "go_on", "Resume"),
        Binding("q", "app.quit", "Leave", tooltip="after this step, with the arm parked"),
        HELP_KEY,
        Binding("enter", "app.begin_again", "Resume the session"),
        Binding("enter", "enlarge", "Large", tooltip="the last capture"),
        Binding("tab", "next_pane", "Pane", tooltip="overview, last capture and camera in turn, if not all fit"),
        Binding("v", "app.review", "Review", tooltip="look through the captures and mark them"),
        Binding("r", "request('RETAKE')", "Retake", tooltip="this or the next stroke, once photographed; r undoes it"),
        Binding("k", "request('SKIP')", "Skip", tooltip="the current stroke"),
        Binding("n", "request('NEW_SHEET')", "New sheet", tooltip="before the next stroke"),
        Binding("j", "request('JOG')", "Jog", tooltip="find the paper again before the next stroke"),
        Binding("b", "mark_last", "Bad", tooltip="the last capture: it is pressed again at the end; b undoes this"),
    ]

    keys_depend_on = reactive((State.IDLE, True, False), bindings=True)
    """What decides which keys do something now; a change of it shows others."""

    def __init__(self, engine: Engine) -> None:
        super().__init__()
        self.engine = engine
        self._now = Snapshot()
        # Kept, not queried: a snapshot may come before the parts are mounted or after they are gone.
        self._title = Bar("title")
        self._state, self._figures = Line("state", sized=True), Line("figures", sized=True)
        self._why, self._why_pane = Line("why"), VerticalScroll(id="why-pane")
        self._grid = DataTable[Text](id="grid", classes="pane", show_cursor=False)
        self._grid.can_focus = False
        self._grid.border_title = "Strokes done/planned by depth H and tilt α"
        self._why_pane.border_title = "Why the run ended"
        self._sheet = Line("sheet", classes="pane")
        self._sheet.show(Content.styled("no sheet yet", "dim"))
        self._model = ModelByNow()
        self._log, self._log_pane = Line("log"), Newest(id="log-pane", classes="pane")
        self._log_pane.border_title = "Log"
        self._capture, self._words = Vertical(id="capture", classes="pane"), Line("capture-words")
        self._words.show(Content.styled("no photograph yet in this run", "dim"))
        self._capture.border_title = "Last capture: photograph, binarised, CCD-BSM"
        self._pictures = [picture_widget(name) for name in ("photo", "binary", "model")]
        self._camera = picture_widget("camera")
        self._camera.add_class("pane")
        self._camera.border_title = "Camera"
        self._note = Bar("note")
        self._pane = 0
        self._figures_turn = False
        self._deaf_until_s = 0.0

    def compose(self) -> ComposeResult:
        """Lay out top to bottom, by how soon the operator needs it."""
        yield self._title
        with Horizontal(id="band"):
            yield self._state
            yield self._figures
        with self._why_pane:
            yield self._why
        with Horizontal():
            with Vertical(id="left"):
                with Horizontal(id="top"):
                    yield self._grid
                    yield self._sheet
                yield self._model
                with self._log_pane:
                    yield self._log
            with Vertical(id="right"):
                with self._capture:
                    yield self._words
                    with Horizontal(id="capture-pictures"):
                        yield from self._pictures
                yield self._camera
        yield self._note
        yield Footer(compact=True, show_command_palette=False)

    def action_next_pane(self) -> None:
        """Show overview, last capture, and camera in turn, on a narrow screen."""
        self._pane = (self._pane + 1) % len(PANES)
        for number, name in enumerate(PANES):
            self.set_class(number == self._pane, f"-{name}")

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Disable the keys that would do nothing now."""
        state, last = self._now.state, self._now.last
        match action:
            case "request" | "mark_last":
                return state not in FINAL
            case "pause":
                # While the arm is being stopped or a question waits, nothing is to be paused.
                return state in (State.IDLE, State.RECOVERING, State.RUNNING)
            case "go_on":
                return state in (State.PAUSING, State.PAUSED)
            case "enlarge":
                # After a stop or a failure, the same key resumes the session.
                return last is not None and state not in FINAL - {State.DONE}
            case _:
                return super().check_action(action, parameters)

    def action_pause(self) -> None:
        """Pause before the next step."""
        self.engine.control.pause()

    def action_go_on(self) -> None:
        """Go on after a pause."""
        self.engine.control.resume()

    def action_request(self, name: str) -> None:
        """Send the engine a request, or withdraw it."""
        if time.monotonic() >= self._deaf_until_s:
            self.engine.control.toggle(OperatorRequest[name])

    def action_mark_last(self) -> None:
        """Mark the newest capture bad, or good again; the mark is on disk at once."""
        last = self._now.last
        if last is None or not last.kept:
            return
        try:
            bad = mark_bad_or_good(Path(self._now.folder), last.still, last.press.stroke_id, time.time_ns())
        except SessionError as error:
            self.notify(plain(str(error)), severity="error", timeout=20)
            return
        mark = "marked bad; it is pressed again after the planned strokes" if bad else "marked good again"
        self.notify(f"{last.press.stroke_id}: {mark}")

    def action_enlarge(self) -> None:
        """Show the last capture large."""
        if (last := self._now.last) is not None:
            model = "CCD-BSM as published" if last.model is not None else "no prediction for this stroke"
            app_of(self).push_screen(CaptureScreen(last, model))

    def answered(self) -> None:
        """A question was answered: leave the keys of requests without effect for a moment."""
        self._deaf_until_s = time.monotonic() + BOUNCE_S

    def show(self, now: Snapshot) -> None:
        """Draw what differs from the previous snapshot."""
        before, self._now = self._now, now
        self.keys_depend_on = now.state, now.last is None, bool(now.folder)
        source, session = one_line(now.source) or "not known yet", one_line(now.session_id) or "no session yet"
        self._title.show(Content.assemble((f" source: {source} ", "$text on $accent"), f"  {session}"))
        self._show_state(now)
        # Figures and camera take turns: textual visits every widget between two that it draws at the same time.
        self._figures_turn = not self._figures_turn or now.state is not before.state
        if self._figures_turn:
            self._figures.show(figures_content(now))
        elif now.picture is not None and self._camera.display:
            self._camera.show(now.picture.image)
        self.set_class(bool(now.error), "-wrong")
        self._why.show(plain(now.error))
        if now.grid != before.grid:
            fill_grid(self._grid, now.grid)
        if now.sheet is not None and now.sheet != before.sheet:
            self._sheet.show(sheet_content(now.sheet))
            self._sheet.border_title = f"Sheet {now.sheet.number}: {now.sheet.marks.count(None)} free"
        if now.messages != before.messages:
            lines = [plain(line) for line in now.messages[-LOG_LINES:]]
            styles = ["bold $text-warning" if line.startswith(WARNING) else "" for line in lines]
            self._log.show(Content("\n").join(map(Content.styled, lines, styles)))
        if (last := now.last) is not None and last is not before.last:
            self._words.show(_capture_words(last))
            pictures = (last.photo, binary_picture(last.binary), binary_picture(last.model))
            for widget, picture in zip(self._pictures, pictures, strict=True):
                widget.show(picture)
        if now.state is State.RUNNING:
            self._model.follow(now.folder, now.strokes_done)
        self._note.show(_note_content(now))

    def _show_state(self, now: Snapshot) -> None:
        state = now.state
        word = f"{state.upper()}\nafter this step" if state is State.PAUSING else state.upper()
        black = "camera is black" if now.picture is not None and now.picture.image.max() < BLACK_LEVEL else ""
        self._state.show("\n".join(filter(None, (word, no_pose_text(now), black))))
        self._state.set_class(now.no_pose_s is not None or bool(black), "-silent")
        for known in State:
            self._state.set_class(known is state, f"-{known}")


def figures_content(now: Snapshot) -> Content:
    """Seven lines: step, strokes with their time, counts, tip, target, force, and the newest forces."""
    left = max(now.strokes_planned - now.strokes_done - now.given_up, 0)
    percent = 100 * now.strokes_done // now.strokes_planned if now.strokes_planned else 0
    going_on = "" if now.state in FINAL else f"   {left} left   {eta_text(now) or 'no ETA yet'}"
    strokes = f"{now.strokes_done}/{now.strokes_planned}  {percent} %   elapsed {minutes_text(now.elapsed_s)}{going_on}"
    ink = "ink level unknown" if now.ink_level is None else f"ink {now.ink_level:.0%} of the well"
    counts = f"{now.voids} interrupted   {now.given_up} left out   {ink}"
    warned = "bold $text-warning" if now.voids or now.given_up else ""
    rows: list[tuple[str, Content | str]] = [
        ("Step", Content.styled(one_line(now.step) or "-", "bold")),
        ("Strokes", strokes),
        ("Counts", Content.styled(counts, warned)),
        *_live_rows(now),
        ("", spark(now.trace_n)),
    ]
    return Content("\n").join(labelled(name, text, 9) for name, text in rows)


def live_content(now: Snapshot) -> Content:
    """Tip, target, force, and focus at this moment, for a person who answers a question."""
    rows = _live_rows(now)
    if now.picture is not None:
        blur_px = now.picture.blur_px
        focus = "no edge in view: the blur is unknown"
        if blur_px is not None:
            focus = f"blur {blur_px:.1f} px  {'✓ sharp' if blur_px < SHARP_PX else '! turn the lens'}"
        rows.append(("Focus", focus))
    return Content("\n").join(labelled(name, text, 9) for name, text in rows)


def _live_rows(now: Snapshot) -> list[tuple[str, Content | str]]:
    """Where the tip is, where the arm was sent and how far it still has to go, and what the brush feels."""
    tip = Content.styled(no_pose_text(now) or "no pose", "bold $text-warning")
    target, force = "no target yet", "not measured now" if now.state in FINAL else "no force sensor, or silent"
    if now.tip_mm is not None:
        tip = Content(_place_text(now.tip_mm))
    if now.target_mm is not None:
        to_go = "" if now.tip_mm is None else f"   {math.dist(now.target_mm, now.tip_mm):.2f} mm to go"
        target = _place_text(now.target_mm) + to_go
    if now.force_n is not None:
        ceiling = "not zeroed yet" if now.force_ceiling_n is None else f"stops at {now.force_ceiling_n:g} N"
        force = f"{now.force_n:6.3f} N ({ceiling})   trace up to {scale_n(now.trace_n):.2g} N"
    return [("Tip", tip), ("Target", target), ("Force", force)]


def _place_text(place_mm: tuple[float, float, float]) -> str:
    x, y, z = place_mm
    return f"x {x:7.2f}  y {y:7.2f}  z {z:7.2f} mm"


def scale_n(values_n: Sequence[float]) -> float:
    """The force that a full block stands for."""
    return max((LEAST_SCALE_N, *values_n))


def spark(values_n: Sequence[float]) -> str:
    """Forces in one row, a full block at `scale_n` of them."""
    full_n = scale_n(values_n)
    return "".join(EIGHTHS[math.ceil(8 * max(value, 0.0) / full_n)] for value in values_n)


def fill_grid(table: DataTable[Text], grid: tuple[ConditionCount, ...]) -> None:
    """Done and planned strokes, a row for each tilt and a column for each depth, with a sign as well as a colour."""
    counts = {count.condition: count for count in grid}
    depths_mm = sorted({condition.depth_mm for condition in counts})
    table.clear(columns=True)
    table.add_columns(Text("α \\ H"), *(Text(f"{depth_mm:g} mm") for depth_mm in depths_mm))
    for tilt_deg in sorted({condition.tilt_deg for condition in counts}):
        row = (count_text(counts.get(Condition(depth_mm, tilt_deg))) for depth_mm in depths_mm)
        table.add_row(Text(f"{tilt_deg:g}°", "bold"), *row)


def count_text(count: ConditionCount | None) -> Text:
    """`1/2 ▶`: strokes done and planned, and the sign of the most important state."""
    if count is None:
        return Text("-", "dim")
    sign = "›" if count.next else "!" if count.bad else ""
    if count.done >= count.planned:
        sign = "!" if count.bad else "✓"
    if count.left_out:
        sign = "×"
    if count.now:
        sign = "▶"
    return Text(f"{count.done}/{count.planned} {sign}", "" if count.done and not sign else GRID_STYLES[sign])


def sheet_content(sheet: SheetMap) -> Content:
    """A sign for what became of each patch, in rows from the far edge, as the camera sees the sheet."""
    signs = [Content.styled(*SHEET_SIGNS[mark]) for mark in sheet.marks]
    rows = (signs[at : at + sheet.columns] for at in range(0, len(signs), sheet.columns))
    return Content("\n").join(Content(" ").join(row) for row in rows)


def _capture_words(last: LastCapture) -> Content:
    """Name, whether it counts, and the checks that it missed; the large view has all of them."""
    kept = ("✓ counts", "bold $text-success") if last.kept else ("! does not count", "bold $text-warning")
    lines = [Content.assemble((last.press.stroke_id, "bold"), f"  {condition_text(last.press.condition)}  ", kept)]
    if last.verdict is None:
        lines.append(Content.styled("not judged: [quality] is switched off", "dim"))
    elif missed := [check for check in last.verdict.checks if not check.passed]:
        lines.append(checks_content(missed))
    else:
        asked = "" if last.kept else "; not counted, as the operator requested"
        lines.append(Content(f"✓ all {len(last.verdict.checks)} checks{asked}"))
    if last.likeness is not None:
        lines.append(Content.styled(f"CCD-BSM as published (right): CSIM {100.0 * last.likeness:.1f} %", "dim"))
    return Content("\n").join(lines)


def _note_content(now: Snapshot) -> Content:
    """Pending requests and the stop key; once the run is over, how to leave."""
    if now.state in FINAL:
        on = GOES_ON if now.folder else COMMAND_GOES_ON
        following = SOFTWARE_STOP if now.state is State.DONE or now.rest_unknown else on
        return Content.assemble((f" {OVER} ", "bold reverse"), f"  {following}")
    if now.state is State.STOPPING:
        return Content.styled(" the arm was not seen at rest yet: press the red button if it moves ", "bold reverse")
    if now.requests:
        asked = ", ".join(now.requests)
        return Content.assemble((f" asked: {asked} ", "bold reverse"), f" {SHORT_STOP}")
    return Content(SOFTWARE_STOP)
