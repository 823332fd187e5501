"""The grid of depths and tilts as a table that fills: `done/planned`, and a sign for each state besides its colour."""

from __future__ import annotations

from textual.app import RenderResult
from textual.content import Content
from textual.widget import Widget

from collect.engine.snapshot import CellCount

COMPLETE, NOW, NEXT, BAD, LEFT_OUT = "✓", "▶", "›", "!", "×"
LEGEND = f"{COMPLETE} done {NOW} now {NEXT} next {BAD} bad takes {LEFT_OUT} left out"
GAP = 2


class Grid(Widget):
    """One row per tilt, or one per depth where only that fits the width."""

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
        """The table."""
        return grid_content(self._cells, self._room)


def grid_content(cells: tuple[CellCount, ...], room: int) -> Content:
    """The table for a width; tilts go down, as there are fewer, unless only depths going down fit."""
    if not cells:
        return Content.styled("no strokes planned", "dim")
    across, down = _table(cells, tilts_down=True), _table(cells, tilts_down=False)
    # The lines of a table are equally wide.
    lines = down if down[0].cell_length <= room < across[0].cell_length else across
    return Content("\n").join(lines)


def _table(cells: tuple[CellCount, ...], *, tilts_down: bool) -> list[Content]:
    by_place = {(cell.height_mm, cell.tilt_deg): cell for cell in cells}
    heights = sorted({cell.height_mm for cell in cells})
    tilts = sorted({cell.tilt_deg for cell in cells})
    height_names, tilt_names = [f"{h:g} mm" for h in heights], [f"{a:g}°" for a in tilts]
    if tilts_down:
        names, heads, corner = tilt_names, height_names, "α \\ H"
        rows = [[by_place.get((h, a)) for h in heights] for a in tilts]
    else:
        names, heads, corner = height_names, tilt_names, "H \\ α"
        rows = [[by_place.get((h, a)) for a in tilts] for h in heights]
    first = max(len(text) for text in (*names, corner))
    width = max(len(text) for text in (*heads, *(_cell_text(cell) for row in rows for cell in row))) + GAP
    lines = [Content.styled(corner.rjust(first) + "".join(head.rjust(width) for head in heads), "bold")]
    for name, row in zip(names, rows, strict=True):
        styled = [(_cell_text(cell).rjust(width), _cell_style(cell)) for cell in row]
        lines.append(Content.assemble((name.rjust(first), "bold"), *styled))
    return lines


def _cell_text(cell: CellCount | None) -> str:
    # The sign has a column of its own, so that counts stay aligned.
    if cell is None:
        return "-  "
    return f"{cell.done}/{cell.planned} {cell_sign(cell)}"


def cell_sign(cell: CellCount) -> str:
    """What matters most about a cell, in one sign."""
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
    match cell_sign(cell):
        case "▶":
            return "bold reverse"
        case "×":
            return "bold $text-error"
        case "!":
            return "bold $text-warning"
        case "✓":
            return "bold $text-success"
        case "›":
            return "bold"
        case _:
            return "" if cell.done else "dim"
