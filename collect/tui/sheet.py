"""The sheet that is in, cell by cell: a sign for what became of each, besides its colour."""

from __future__ import annotations

from textual.content import Content

from collect.engine.tally import Mark, SheetMap

SIGNS: dict[Mark | None, tuple[str, str]] = {
    None: ("·", "dim"),
    Mark.NOW: ("▶", "bold reverse"),
    Mark.WAITING: ("●", "bold"),
    Mark.KEPT: ("●", "$text-success"),
    Mark.BAD: ("!", "bold $text-warning"),
    Mark.VOID: ("×", "bold $text-error"),
    Mark.CHECK: ("△", "dim"),
}


def sheet_content(sheet: SheetMap | None) -> Content:
    """Rows from the far edge, as the camera sees the sheet."""
    if sheet is None or not sheet.marks:
        return Content.styled("no sheet yet", "dim")
    rows: list[Content] = []
    for row in range(sheet.rows):
        marks = sheet.marks[row * sheet.columns : (row + 1) * sheet.columns]
        rows.append(Content(" ").join(Content.styled(*SIGNS[mark]) for mark in marks))
    return Content("\n").join(rows)


def sheet_title(sheet: SheetMap | None) -> str:
    """Which sheet, and how many cells are free."""
    if sheet is None:
        return "Sheet"
    free = sum(mark is None for mark in sheet.marks)
    return f"Sheet {sheet.number}: {free} free"
