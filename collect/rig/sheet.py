"""Where presses land: the cells of a sheet, and the way from the paper frame to the base frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

from collect.errors import SheetFull
from collect.protocols.planned import Layout
from collect.rig.config import PaperConfig

ANCHOR_SHARE = 0.75
"""The zero-touch point's place along a cell: the mark reaches mostly toward -x, where the tip lies."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A patch of paper for one press, in the paper frame."""

    index: int
    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float

    @property
    def anchor_mm(self) -> tuple[float, float]:
        """The zero-touch point."""
        return self.x_mm + ANCHOR_SHARE * self.width_mm, self.y_mm + 0.5 * self.height_mm

    @property
    def rect_mm(self) -> tuple[float, float, float, float]:
        """x, y, width, height."""
        return self.x_mm, self.y_mm, self.width_mm, self.height_mm


class Sheet:
    """The cells of one sheet, row by row from the far edge, so that the arm never reaches across wet ink."""

    def __init__(self, paper: PaperConfig, cell_mm: tuple[float, float] | None = None) -> None:
        """`cell_mm` is what the protocol needs; None is `paper.cell_mm`."""
        self.cell_mm = paper.cell_mm if cell_mm is None else cell_mm
        width, height = paper.size_mm
        cell_w, cell_h = self.cell_mm
        self.columns = int(width // cell_w)
        self.rows = int(height // cell_h)
        self._left = 0.5 * (width - self.columns * cell_w)
        self._bottom = 0.5 * (height - self.rows * cell_h)

    @property
    def capacity(self) -> int:
        """Cells on a sheet."""
        return self.columns * self.rows

    @property
    def layout(self) -> Layout:
        """Its columns and rows."""
        return Layout(self.columns, self.rows)

    @property
    def corners(self) -> list[Cell]:
        """The outermost cells: what fits there within a convex box fits on all of them. None on an empty sheet."""
        if not self.capacity:
            return []
        last_row = self.capacity - self.columns
        return [self.cell(i) for i in sorted({0, self.columns - 1, last_row, self.capacity - 1})]

    def cell(self, index: int) -> Cell:
        """The cell of that number."""
        if not 0 <= index < self.capacity:
            raise IndexError(f"cell {index} is outside [0, {self.capacity - 1}]")
        row, column = divmod(index, self.columns)
        cell_w, cell_h = self.cell_mm
        y_mm = self._bottom + (self.rows - 1 - row) * cell_h
        return Cell(index, self._left + column * cell_w, y_mm, cell_w, cell_h)

    def free(self, used: set[int], sheet: int = 1) -> Cell:
        """The first cell of that sheet that no press has ever been begun on. Raises `SheetFull`."""
        for index in range(self.capacity):
            if index not in used:
                return self.cell(index)
        raise SheetFull(self.capacity, sheet)


def to_base(paper: PaperConfig, x_mm: float, y_mm: float) -> tuple[float, float]:
    """A point of the paper frame in the base frame."""
    yaw = math.radians(paper.yaw_deg)
    return (
        paper.origin_mm[0] + math.cos(yaw) * x_mm - math.sin(yaw) * y_mm,
        paper.origin_mm[1] + math.sin(yaw) * x_mm + math.cos(yaw) * y_mm,
    )
