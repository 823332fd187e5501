"""The parts of the run screen: figures, the grid of strokes, the map of the sheet, the newest capture."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from rich.cells import cell_len
from textual.app import ComposeResult, RenderResult
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.widget import Widget

from brushloop.collect.engine.control import FINAL
from brushloop.collect.engine.snapshot import CellCount, Mark, SheetMap, Snapshot
from brushloop.collect.headless import eta_text, minutes_text, no_pose_text
from brushloop.collect.quality.verdict import Check
from brushloop.collect.tui.large import limit_sign, number_text
from brushloop.collect.tui.pictures import Pictures, binary_picture
from brushloop.collect.tui.text import age_text, bar_text, condition_text, one_line, scale_n, spark, tip_text
from brushloop.collect.tui.widgets import Line, entitle
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from brushloop.collect.engine.last_capture import LastCapture

LABEL, LONGEST_TRACE = 9, 60
"""Columns of a figure's name, and the most columns of the force trace."""
COMPLETE, NOW, NEXT, BAD, LEFT_OUT = "✓", "▶", "›", "!", "×"
LEGEND = f"{COMPLETE} done {NOW} now {NEXT} next {BAD} bad takes {LEFT_OUT} left out"
GRID_STYLES = {
    NOW: "bold reverse",
    LEFT_OUT: "bold $text-error",
    BAD: "bold $text-warning",
    COMPLETE: "bold $text-success",
    NEXT: "bold",
}
SHARP_PX = 2.0
"""Blur in the full frame below which the lens is in focus: a hint for turning it; the step's own check decides."""
LIVE_COLUMNS = 55
"""Columns of the force beside a question."""
GAP = 2
SHEET_SIGNS: dict[Mark | None, tuple[str, str]] = {
    None: ("·", "dim"),
    Mark.NOW: ("▶", "bold reverse"),
    Mark.WAITING: ("●", "bold"),
    Mark.KEPT: ("●", "$text-success"),
    Mark.BAD: ("!", "bold $text-warning"),
    Mark.VOID: ("×", "bold $text-error"),
    Mark.CHECK: ("△", "dim"),
}
A_LINE, CHECK_WIDTH = 2, 24
"""Quality checks on a line, and columns of each: as many as fit beside the grid on 120 columns."""


def figures_content(now: Snapshot, width: int) -> Content:
    """Seven lines: step, strokes, time, counts, tip, target, force."""
    rows = (
        ("Step", one_line(now.step) or "-", "bold"),
        ("Strokes", _strokes(now, width), ""),
        ("Time", _time(now), ""),
        ("Counts", *_counts(now)),
        ("Tip", no_pose_text(now) or tip_text(now.tip_mm), "" if now.tip_mm else "bold $text-warning"),
        ("Target", target_text(now), ""),
        ("Force", _force(now, width - LABEL), ""),
    )
    lines = [Content.assemble((label.ljust(LABEL), "dim"), (text, style)) for label, text, style in rows]
    return Content("\n").join(lines)


def _strokes(now: Snapshot, width: int) -> str:
    counts = bar_text(now.strokes_done, now.strokes_planned, 0)
    return bar_text(now.strokes_done, now.strokes_planned, max(width - LABEL - cell_len(counts) - 1, 4))


def _time(now: Snapshot) -> str:
    elapsed = f"elapsed {minutes_text(now.elapsed_s)}"
    if now.state in FINAL:
        return elapsed
    left = max(now.strokes_planned - now.strokes_done - now.given_up, 0)
    return f"{elapsed}   {eta_text(now) or 'no ETA yet'}   {left} strokes left"


def _counts(now: Snapshot) -> tuple[str, str]:
    parts = [f"voids {now.voids}"]
    if now.given_up:
        parts.append(f"left out {now.given_up}")
    parts.append("ink level unknown" if now.ink_level is None else f"ink {now.ink_level:.0%} of the well")
    return "   ".join(parts), "bold $text-warning" if now.voids or now.given_up else ""


def live_content(now: Snapshot) -> Content:
    """Tip, target, force, and focus at this moment, for a person who answers a question."""
    rows = [("Tip", no_pose_text(now) or tip_text(now.tip_mm)), ("Target", target_text(now))]
    if now.force_n is not None:
        rows.append(("Force", _force(now, LIVE_COLUMNS)))
    if now.picture is not None:
        rows.append(("Focus", _focus_text(now.picture.blur_px)))
    return Content("\n").join(Content.assemble((name.ljust(LABEL), "dim"), text) for name, text in rows)


def _focus_text(blur_px: float | None) -> str:
    if blur_px is None:
        return "no edge in view to measure"
    return f"blur {blur_px:.1f} px  {'✓ sharp' if blur_px < SHARP_PX else '! turn the lens'}"


def target_text(now: Snapshot) -> str:
    """Where the arm was sent, and how far it still has to go."""
    if now.target_mm is None:
        return "no target yet"
    if now.tip_mm is None:
        return tip_text(now.target_mm)
    return f"{tip_text(now.target_mm)}   {math.dist(now.target_mm, now.tip_mm):.2f} mm to go"


def _force(now: Snapshot, room: int) -> str:
    if now.force_n is None:
        return "not measured now" if now.state in FINAL else "no force sensor, or silent"
    ceiling = "" if now.force_ceiling_n is None else f" (stops at {now.force_ceiling_n:g} N)"
    force = f"{now.force_n:6.3f} N{ceiling}  "
    scale = f"plotted to {scale_n(now.trace_n[-LONGEST_TRACE:]):g} N "
    width = max(0, min(room - len(force) - len(scale), LONGEST_TRACE))
    return force + (scale + spark(now.trace_n, width) if width else "")


class Grid(Widget):
    """Done and planned strokes by depth H and tilt alpha, with a sign for each state as well as a colour."""

    DEFAULT_CSS = """
    Grid { width: auto; min-width: 100%; height: auto; text-wrap: nowrap; }
    """

    def __init__(self) -> None:
        super().__init__()
        self._cells: tuple[CellCount, ...] = ()
        self._room = 0

    def show(self, cells: tuple[CellCount, ...], room: int) -> None:
        """Render the counts for `room` columns, if either changed."""
        if (cells, room) != (self._cells, self._room):
            self._cells, self._room = cells, room
            self.refresh(layout=True)

    def render(self) -> RenderResult:
        """Draw the table."""
        return grid_content(self._cells, self._room)


def grid_content(cells: tuple[CellCount, ...], room: int) -> Content:
    """The table with a row per tilt (there are fewer of them), or per depth where only that fits `room` columns."""
    if not cells:
        return Content.styled("no strokes planned", "dim")
    by_tilt, by_depth = _table(cells, tilts_down=True), _table(cells, tilts_down=False)
    # The lines of a table are equally wide.
    lines = by_depth if by_depth[0].cell_length <= room < by_tilt[0].cell_length else by_tilt
    return Content("\n").join(lines)


def _table(cells: tuple[CellCount, ...], *, tilts_down: bool) -> list[Content]:
    counts = {cell.condition: cell for cell in cells}
    depths_mm = sorted({cell.condition.depth_mm for cell in cells})
    tilts_deg = sorted({cell.condition.tilt_deg for cell in cells})
    names, heads, corner = [f"{a:g}°" for a in tilts_deg], [f"{h:g} mm" for h in depths_mm], "α \\ H"
    rows = [[counts.get(Condition(h, a)) for h in depths_mm] for a in tilts_deg]
    if not tilts_down:
        names, heads, corner = heads, names, "H \\ α"
        rows = [list(column) for column in zip(*rows, strict=True)]
    first = max(len(text) for text in (*names, corner))
    width = max(len(text) for text in (*heads, *(_cell_text(cell) for row in rows for cell in row))) + GAP
    lines = [Content.styled(corner.rjust(first) + "".join(head.rjust(width) for head in heads), "bold")]
    for name, row in zip(names, rows, strict=True):
        styled = [(_cell_text(cell).rjust(width), _cell_style(cell)) for cell in row]
        lines.append(Content.assemble((name.rjust(first), "bold"), *styled))
    return lines


def _cell_text(cell: CellCount | None) -> str:
    # The sign has a column of its own, so that counts stay aligned.
    return "-  " if cell is None else f"{cell.done}/{cell.planned} {_cell_sign(cell)}"


def _cell_sign(cell: CellCount) -> str:
    """The sign of a cell's most important state."""
    if cell.now:
        return NOW
    if cell.left_out:
        return LEFT_OUT
    if cell.done >= cell.planned:
        return BAD if cell.bad else COMPLETE
    if cell.next:
        return NEXT
    return BAD if cell.bad else " "


def _cell_style(cell: CellCount | None) -> str:
    if cell is None:
        return "dim"
    return GRID_STYLES.get(_cell_sign(cell), "" if cell.done else "dim")


def sheet_content(sheet: SheetMap | None) -> Content:
    """A sign for what became of each paper cell, in rows from the far edge, as the camera sees the sheet."""
    if sheet is None or not sheet.marks:
        return Content.styled("no sheet yet", "dim")
    rows: list[Content] = []
    for row in range(sheet.rows):
        marks = sheet.marks[row * sheet.columns : (row + 1) * sheet.columns]
        rows.append(Content(" ").join(Content.styled(*SHEET_SIGNS[mark]) for mark in marks))
    return Content("\n").join(rows)


def sheet_title(sheet: SheetMap | None) -> str:
    """Which sheet is in, and how many of its cells are free."""
    if sheet is None:
        return "Sheet"
    free = sum(mark is None for mark in sheet.marks)
    return f"Sheet {sheet.number}: {free} free"


class CapturePane(Vertical):
    """The newest capture: its photograph, the binarised image, the model's image, and how it was judged."""

    DEFAULT_CSS = """
    CapturePane { height: 1fr; }
    CapturePane #capture-words { height: auto; max-height: 50%; }
    CapturePane #capture-pictures { height: 1fr; min-height: 4; }
    CapturePane #photo, CapturePane #binary { margin-right: 1; }
    """

    def __init__(self, pictures: Pictures, now_s: Callable[[], float]) -> None:
        super().__init__(id="capture-pane", classes="pane")
        self.border_title = "Last capture"
        self._now_s = now_s
        self._since_s = 0.0
        self._words = Line("capture-words")
        self._photo, self._binary, self._model = (pictures.make(name) for name in ("photo", "binary", "model"))
        self._shown: LastCapture | None = None

    async def on_click(self) -> None:
        """Show this capture large."""
        await self.run_action("app.enlarge")

    def compose(self) -> ComposeResult:
        """Lay out the words above, the pictures below."""
        yield self._words
        with Horizontal(id="capture-pictures"):
            yield self._photo
            yield self._binary
            yield self._model

    def show(self, last: LastCapture | None) -> None:
        """Draw this capture if it is a new one."""
        if last is None:
            self._words.show(Content.styled("no photograph yet since this start", "dim"))
            return
        if last is not self._shown:
            self._since_s = self._now_s()
        entitle(self, f"Capture, {age_text(self._now_s() - self._since_s)}: photograph, binarised, CCD-BSM")
        if last is self._shown:
            return
        self._shown = last
        self._words.show(_capture_words(last))
        self._photo.show(last.photo)
        self._binary.show(None if last.binary is None else binary_picture(last.binary))
        self._model.show(None if last.model is None else binary_picture(last.model))


def _capture_words(last: LastCapture) -> Content:
    """Name, verdict, and the score of each check."""
    kept = ("✓ counts", "bold $text-success") if last.kept else ("! does not count", "bold $text-warning")
    lines = [Content.assemble((last.press.stroke_id, "bold"), f"  {condition_text(last.press.condition)}  ", kept)]
    if last.verdict is None:
        lines.append(Content.styled("not judged: [quality] is switched off", "dim"))
    else:
        if last.verdict.reason:
            lines.append(Content.styled(last.verdict.reason, "$text-warning"))
        checks = [_check(check) for check in sorted(last.verdict.checks, key=lambda check: check.passed)]
        lines += [Content("  ").join(checks[k : k + A_LINE]) for k in range(0, len(checks), A_LINE)]
    if last.model is not None:
        csim = "" if last.likeness is None else f": CSIM {100.0 * last.likeness:.1f} % in mm"
        lines.append(Content.styled(f"CCD-BSM as published for this H and α, right{csim}", "dim"))
    return Content("\n").join(lines)


def _check(check: Check) -> Content:
    sign, style = ("✓", "") if check.passed else ("!", "bold $text-warning")
    limit = f" {limit_sign(check)} {number_text(check.threshold)}"
    # In columns, because a line break could separate the sign from its check.
    text = f"{sign} {check.name} {number_text(check.score)}"
    return Content.assemble((text, style), (limit.ljust(CHECK_WIDTH - len(text)), "dim"))
