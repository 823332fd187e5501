"""The run screen: one `Snapshot` after the other, from the first retreat to the end of the run."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import DataTable, Footer

from brushloop.collect.engine.control import FINAL, State
from brushloop.collect.engine.snapshot import CellCount, Mark, SheetMap, Snapshot
from brushloop.collect.headless import eta_text, minutes_text, no_pose_text
from brushloop.collect.tui.capture_screen import checks_content
from brushloop.collect.tui.pictures import Pictures, binary_picture
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    NARROW_COLUMNS,
    SHORT_STOP,
    SOFTWARE_STOP,
    STOP,
    Line,
    condition_text,
    entitle,
    labelled,
    one_line,
    plain,
    tip_text,
)
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from brushloop.collect.engine.last_capture import LastCapture

OVER = "Over: q leaves"
GOES_ON = "Press enter to resume, or run the same command later."
COMMAND_GOES_ON = "Run the same command again to continue."
STOP_SENT = "STOP SENT"
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
EIGHTHS = " ▁▂▃▄▅▆▇█"
TRACE_PEAKS = 50
"""Peaks of the force that are drawn, of a tenth of a second each."""
LEAST_SCALE_N = 0.1
"""Smallest full scale, so that noise is not stretched: a soft brush pushes with a few tens of mN."""
RUN_BINDINGS = (
    STOP,
    Binding("space,p", "app.pause", "Pause", tooltip="before the next step"),
    Binding("space,p", "app.go_on", "Resume"),
    Binding("q", "app.quit", "Leave", tooltip="after this step, with the arm parked"),
    HELP_KEY,
    Binding("enter", "app.begin_again", "Resume the session"),
    Binding("enter", "app.enlarge", "Large", tooltip="the last capture"),
    Binding("tab", "next_pane", "Pane", tooltip="overview, last capture, camera, where not all fit"),
    Binding("v", "app.review", "Review", tooltip="look through the captures, mark and compare them"),
    Binding("r", "app.request('RETAKE')", "Retake", tooltip="the current stroke, once photographed; r takes it back"),
    Binding("k", "app.request('SKIP')", "Skip", tooltip="the current stroke"),
    Binding("n", "app.request('NEW_SHEET')", "New sheet", tooltip="before the next stroke"),
    Binding("j", "app.request('JOG')", "Jog", tooltip="find the paper again before the next stroke"),
    Binding("b", "app.mark_last", "Bad", tooltip="the last capture: pressed again at the end; b takes it back"),
)
"""Most important first: a narrow screen shows only as many as fit."""


class LogPane(VerticalScroll, inherit_bindings=False):
    """Scrolls by page, with few keys, so that the help lists those of the run first."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("pageup", "page_up", "Older lines", show=False),
        Binding("pagedown", "page_down", "Newer lines", show=False),
    ]


class RunScreen(Screen[None], inherit_bindings=False):
    """Draws snapshots; keeps only what is on the screen."""

    AUTO_FOCUS = "#log-pane"
    HELP = """
Grid: ✓ complete, ▶ now, › next, ! bad takes, × left out

Sheet: · blank, ● counts, ! does not, × cut short, △ self-check
"""
    DEFAULT_CSS = """
    RunScreen #title { height: 1; background: $panel; }
    RunScreen #session { width: 1fr; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis; }
    RunScreen #source {
        width: auto; max-width: 50%; padding: 0 1; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
        background: $accent; color: $text;
    }
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
    RunScreen #why { height: auto; }
    RunScreen #why-pane { display: none; height: auto; max-height: 60%; border: heavy $error; padding: 0 1; }
    RunScreen.-wrong #why-pane { display: block; }
    RunScreen #body { height: 1fr; }
    RunScreen #left { width: 1fr; }
    RunScreen #right { width: 45%; }
    RunScreen #top { height: auto; max-height: 70%; }
    RunScreen #grid { width: 1fr; height: auto; max-height: 100%; }
    RunScreen #sheet { width: auto; max-width: 40%; height: auto; min-width: 18; }
    RunScreen.-narrow.-wrong #sheet { display: none; }
    RunScreen #log-pane { height: 1fr; }
    RunScreen #capture { height: 1fr; }
    RunScreen #capture-words { height: auto; max-height: 50%; }
    RunScreen #capture-pictures { height: 1fr; min-height: 4; }
    RunScreen #camera { height: 1fr; }
    RunScreen.-narrow #right { display: none; }
    RunScreen.-narrow.-capture #right, RunScreen.-narrow.-camera #right { display: block; width: 1fr; }
    RunScreen.-narrow.-capture #left, RunScreen.-narrow.-camera #left { display: none; }
    RunScreen.-narrow.-capture #camera, RunScreen.-narrow.-camera #capture { display: none; }
    RunScreen #note { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; text-overflow: ellipsis; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [*RUN_BINDINGS]

    def __init__(self, pictures: Pictures, *, resumable: bool = False) -> None:
        """`resumable`: whether this screen can go on with a run that was stopped."""
        super().__init__()
        self._resumable = resumable
        # Kept, not queried: a snapshot may come before the parts are mounted or after they are gone.
        self._session, self._source = Line("session"), Line("source")
        self._state, self._figures = Line("state", sized=True), Line("figures", sized=True)
        self._why, self._why_pane = Line("why"), VerticalScroll(id="why-pane")
        self._grid = DataTable[Text](id="grid", classes="pane", show_cursor=False)
        self._grid.can_focus = False
        self._grid.border_title = "Strokes done/planned by depth H and tilt α"
        self._sheet = Line("sheet", classes="pane")
        self._log, self._log_pane = Line("log"), LogPane(id="log-pane", classes="pane")
        self._log_pane.border_title = "Log"
        self._capture, self._words = Vertical(id="capture", classes="pane"), Line("capture-words")
        self._capture.border_title = "Last capture: photograph, binarised, CCD-BSM"
        self._pictures = [pictures.make(name) for name in ("photo", "binary", "model")]
        self._camera, self._with_camera = pictures.make("camera"), pictures.camera_shown
        self._camera.add_class("pane")
        self._camera.border_title = "Camera"
        self._note = Line("note", sized=True)
        self._cells: tuple[CellCount, ...] = ()
        self._messages: tuple[str, ...] = ()
        self._last: LastCapture | None = None
        self._pane = 0
        self._doing: tuple[State, str] | None = None
        self._turn = 0
        self._stop_sent = False

    def compose(self) -> ComposeResult:
        """Lay out top to bottom, by how soon the operator needs it."""
        with Horizontal(id="title"):
            yield self._session
            yield self._source
        with Horizontal(id="band"):
            yield self._state
            yield self._figures
        with self._why_pane:
            yield self._why
        with Horizontal(id="body"):
            with Vertical(id="left"):
                with Horizontal(id="top"):
                    yield self._grid
                    yield self._sheet
                with self._log_pane:
                    yield self._log
            with Vertical(id="right"):
                with self._capture:
                    yield self._words
                    with Horizontal(id="capture-pictures"):
                        yield from self._pictures
                if self._with_camera:
                    yield self._camera
        yield self._note
        yield Footer(compact=True, show_command_palette=False)

    def on_mount(self) -> None:
        """Keep the log at its newest line until the operator scrolls away."""
        self._log_pane.anchor()

    def on_resize(self, event: events.Resize) -> None:
        """Choose what to show for the terminal's width."""
        self.set_class(event.size.width < NARROW_COLUMNS, "-narrow")

    def action_next_pane(self) -> None:
        """Show overview, last capture, and camera in turn, on a narrow screen."""
        shown = PANES if self._with_camera else PANES[:-1]
        self._pane = (self._pane + 1) % len(shown)
        for name in PANES:
            self.set_class(name == shown[self._pane], f"-{name}")

    def stop_sent(self) -> None:
        """Show at once that a stop key was pressed, before the engine answers."""
        self._stop_sent = True
        self._state.show(STOP_SENT)
        self._state.set_class(True, "-stopping")

    def show(self, now: Snapshot) -> None:
        """Draw what differs from the previous snapshot.

        Figures and camera take turns (5 times a second each), because textual visits every widget between two that it
        draws at the same time. A new state or step is shown at once.
        """
        self._turn = 0 if self._doing != (now.state, now.step) else self._turn + 1
        self._doing = now.state, now.step
        self._session.show(f"brushloop  {one_line(now.session_id) or 'no session yet'}")
        self._source.show(f"source: {one_line(now.source) or 'not known yet'}")
        self._show_state(now)
        if self._turn % 2 == 0:
            self._figures.show(figures_content(now))
        elif now.picture is not None and self._camera.display:
            self._camera.show(now.picture.image)
        self.set_class(bool(now.error), "-wrong")
        entitle(self._why_pane, "Why it failed" if now.state is State.FAILED else "Why it stopped")
        self._why.show(plain(now.error))
        if now.grid != self._cells:
            self._cells = now.grid
            fill_grid(self._grid, now.grid)
        self._sheet.show(sheet_content(now.sheet))
        if now.sheet is not None:
            entitle(self._sheet, f"Sheet {now.sheet.number}: {now.sheet.marks.count(None)} free")
        if now.messages != self._messages:
            self._messages = now.messages
            self._log.show(Content("\n").join(_message_content(line) for line in now.messages))
        self._show_capture(now.last)
        self._note.show(_note_content(now, resumable=self._resumable and bool(now.folder)))

    def _show_state(self, now: Snapshot) -> None:
        state = now.state
        self._stop_sent = self._stop_sent and state not in FINAL | {State.STOPPING}
        word = f"{state.upper()}\nafter this step" if state is State.PAUSING else state.upper()
        self._state.show("\n".join(filter(None, (STOP_SENT if self._stop_sent else word, no_pose_text(now)))))
        self._state.set_class(now.no_pose_s is not None, "-silent")
        for known in State:
            self._state.set_class(known is (State.STOPPING if self._stop_sent else state), f"-{known}")

    def _show_capture(self, last: LastCapture | None) -> None:
        """Draw this capture if it is a new one."""
        if last is None:
            self._words.show(Content.styled("no photograph yet since this start", "dim"))
            return
        if last is not self._last:
            self._last = last
            self._words.show(_capture_words(last))
            pictures = (last.photo, binary_picture(last.binary), binary_picture(last.model))
            for widget, picture in zip(self._pictures, pictures, strict=True):
                widget.show(picture)


def figures_content(now: Snapshot) -> Content:
    """Seven lines: step, strokes with their time, counts, tip, target, force, and the newest forces."""
    left = max(now.strokes_planned - now.strokes_done - now.given_up, 0)
    percent = 100 * now.strokes_done // now.strokes_planned if now.strokes_planned else 0
    going_on = "" if now.state in FINAL else f"   {left} left   {eta_text(now) or 'no ETA yet'}"
    strokes = f"{now.strokes_done}/{now.strokes_planned}  {percent} %   elapsed {minutes_text(now.elapsed_s)}{going_on}"
    counts = [f"voids {now.voids}", f"left out {now.given_up}" if now.given_up else ""]
    counts.append("ink level unknown" if now.ink_level is None else f"ink {now.ink_level:.0%} of the well")
    warned = "bold $text-warning" if now.voids or now.given_up else ""
    rows: list[tuple[str, Content | str]] = [
        ("Step", Content.styled(one_line(now.step) or "-", "bold")),
        ("Strokes", strokes),
        ("Counts", Content.styled("   ".join(filter(None, counts)), warned)),
        ("Tip", Content.styled(no_pose_text(now) or tip_text(now.tip_mm), "" if now.tip_mm else "bold $text-warning")),
        ("Target", _target_text(now)),
        ("Force", _force_text(now)),
        ("", spark(now.trace_n[-TRACE_PEAKS:])),
    ]
    return Content("\n").join(labelled(name, text, 9) for name, text in rows)


def live_content(now: Snapshot) -> Content:
    """Tip, target, force, and focus at this moment, for a person who answers a question."""
    rows = [("Tip", no_pose_text(now) or tip_text(now.tip_mm)), ("Target", _target_text(now))]
    if now.force_n is not None:
        rows.append(("Force", _force_text(now)))
    if now.picture is not None:
        blur_px = now.picture.blur_px
        focus = "no edge in view to measure"
        if blur_px is not None:
            focus = f"blur {blur_px:.1f} px  {'✓ sharp' if blur_px < SHARP_PX else '! turn the lens'}"
        rows.append(("Focus", focus))
    return Content("\n").join(labelled(name, text, 9) for name, text in rows)


def _target_text(now: Snapshot) -> str:
    """Where the arm was sent, and how far it still has to go."""
    if now.target_mm is None:
        return "no target yet"
    to_go = "" if now.tip_mm is None else f"   {math.dist(now.target_mm, now.tip_mm):.2f} mm to go"
    return tip_text(now.target_mm) + to_go


def _force_text(now: Snapshot) -> str:
    if now.force_n is None:
        return "not measured now" if now.state in FINAL else "no force sensor, or silent"
    ceiling = "" if now.force_ceiling_n is None else f" (stops at {now.force_ceiling_n:g} N)"
    return f"{now.force_n:6.3f} N{ceiling}   drawn to {scale_n(now.trace_n[-TRACE_PEAKS:]):g} N"


def scale_n(values_n: Sequence[float]) -> float:
    """The full scale for these forces: 0.1, 0.2, 0.5, 1, 2, 5 ... N, whatever holds the largest."""
    top = max(values_n, default=0.0)
    ladder = (LEAST_SCALE_N * step * 10.0**decade for decade in itertools.count() for step in (1.0, 2.0, 5.0))
    return next(full for full in ladder if top <= full) if math.isfinite(top) else LEAST_SCALE_N


def spark(values_n: Sequence[float]) -> str:
    """Forces in one row, a full block at `scale_n` of them."""
    full_n = scale_n(values_n)
    return "".join(EIGHTHS[math.ceil(8 * max(value, 0.0) / full_n)] for value in values_n)


def fill_grid(table: DataTable[Text], cells: tuple[CellCount, ...]) -> None:
    """Done and planned strokes, a row for each tilt and a column for each depth, with a sign as well as a colour."""
    counts = {cell.condition: cell for cell in cells}
    depths_mm = sorted({cell.condition.depth_mm for cell in cells})
    table.clear(columns=True)
    table.add_columns(Text("α \\ H"), *(Text(f"{depth_mm:g} mm") for depth_mm in depths_mm))
    for tilt_deg in sorted({cell.condition.tilt_deg for cell in cells}):
        row = (cell_text(counts.get(Condition(depth_mm, tilt_deg))) for depth_mm in depths_mm)
        table.add_row(Text(f"{tilt_deg:g}°", "bold"), *row)


def cell_text(cell: CellCount | None) -> Text:
    """`1/2 ▶`: strokes done and planned, and the sign of the most important state."""
    if cell is None:
        return Text("-", "dim")
    sign = "›" if cell.next else "!" if cell.bad else ""
    if cell.done >= cell.planned:
        sign = "!" if cell.bad else "✓"
    if cell.left_out:
        sign = "×"
    if cell.now:
        sign = "▶"
    return Text(f"{cell.done}/{cell.planned} {sign}", "" if cell.done and not sign else GRID_STYLES[sign])


def sheet_content(sheet: SheetMap | None) -> Content:
    """A sign for what became of each patch, in rows from the far edge, as the camera sees the sheet."""
    if sheet is None:
        return Content.styled("no sheet yet", "dim")
    signs = [Content.styled(*SHEET_SIGNS[mark]) for mark in sheet.marks]
    rows = (signs[at : at + sheet.columns] for at in range(0, len(signs), sheet.columns))
    return Content("\n").join(Content(" ").join(row) for row in rows)


def _capture_words(last: LastCapture) -> Content:
    """Name, whether it counts, and the checks that it missed; the large view has all of them."""
    kept = ("✓ counts", "bold $text-success") if last.kept else ("! does not count", "bold $text-warning")
    lines = [Content.assemble((last.press.stroke_id, "bold"), f"  {condition_text(last.press.condition)}  ", kept)]
    if last.verdict is None:
        lines.append(Content.styled("not judged: [quality] is switched off", "dim"))
    elif missed := tuple(check for check in last.verdict.checks if not check.passed):
        lines.append(checks_content(missed))
    else:
        lines.append(Content(f"✓ all {len(last.verdict.checks)} checks"))
    if last.likeness is not None:
        words = f"CCD-BSM as published for this H and α, right: CSIM {100.0 * last.likeness:.1f} % in mm"
        lines.append(Content.styled(words, "dim"))
    return Content("\n").join(lines)


def _message_content(line: str) -> Content:
    text = plain(line)
    return Content.styled(text, "bold $text-warning") if text.startswith(WARNING) else Content(text)


def _note_content(now: Snapshot, *, resumable: bool) -> Content:
    """Pending requests and the stop key; once the run is over, how to leave."""
    if now.state in FINAL:
        on = GOES_ON if resumable else COMMAND_GOES_ON
        following = SOFTWARE_STOP if now.state is State.DONE or now.rest_unknown else on
        return Content.assemble((f" {OVER} ", "bold reverse"), f"  {following}")
    if now.state is State.STOPPING:
        return Content.styled(" not seen at rest yet: press the red button if it moves ", "bold reverse")
    if now.requests:
        asked = ", ".join(request.short for request in now.requests)
        return Content.assemble((f" asked: {asked} ", "bold reverse"), f" {SHORT_STOP}")
    return Content(SOFTWARE_STOP)
