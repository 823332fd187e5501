"""Cells of CSV files: text that a spreadsheet would run as a formula is prefixed with an apostrophe.

What a cell says as a number is read by `number`.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

MARK = "'"
NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
FORMULA_STARTS = frozenset("=+-@\t\r\n＝＋－＠")


def as_cell(value: object) -> object:
    """Cell for a value: numbers, also as text (`-0.5`), are unchanged; other text is never a formula."""
    if isinstance(value, str) and value and (value[0] in FORMULA_STARTS or _marked(value)) and not _is_number(value):
        return MARK + value
    return value


def as_text(cell: str) -> str:
    """Undo `as_cell`."""
    return cell[1:] if _marked(cell) else cell


def number(text: str) -> float:
    """The finite number in a cell, an option or an answer: `10`, `-0.5`, `1e3`. Raises ValueError.

    `1_0`, which Python reads as 10, is not one: in a table it is a typing error.
    """
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text[:80]!r} is not a finite number")
    return value


class CsvWriter:
    """Writes a CSV file whose cells may hold untrusted text."""

    def __init__(self, file: Any, lineterminator: str = "\n") -> None:
        self._out = csv.writer(file, lineterminator=lineterminator)  # noqa: TID251 - the one place

    def writerow(self, row: Iterable[object]) -> None:
        """Write one row."""
        self._out.writerow([as_cell(value) for value in row])

    def writerows(self, rows: Iterable[Sequence[object]]) -> None:
        """Write many rows."""
        for row in rows:
            self.writerow(row)


def _marked(text: str) -> bool:
    rest = text.lstrip(MARK)
    return rest != text and rest[:1] in FORMULA_STARTS


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
