"""Force as text: a row of blocks, a plot with an axis, a bar. Every scale is a round number of newtons."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from textual.content import Content

FULL, EMPTY = "█", "░"
EIGHTHS = " ▁▂▃▄▅▆▇█"
LEAST_SCALE_N = 0.1
"""Smallest full scale, so that noise is not stretched: a soft brush pushes with a few tens of mN."""
AXIS = 8
"""Columns of the axis of a plot."""
CEILING = "╌"


def scale_n(values_n: Sequence[float]) -> float:
    """The full scale for these forces: 0.1, 0.2, 0.5, 1, 2, 5 ... N, whatever holds the largest."""
    top = max(values_n, default=0.0)
    ladder = (LEAST_SCALE_N * step * 10.0**decade for decade in itertools.count() for step in (1.0, 2.0, 5.0))
    return next(full for full in ladder if top <= full) if math.isfinite(top) else LEAST_SCALE_N


def spark(values_n: Sequence[float], width: int) -> str:
    """The newest forces in one row, a full block at `scale_n` of them."""
    shown = values_n[-width:] if width > 0 else ()
    full = scale_n(shown)
    return "".join(EIGHTHS[math.ceil(8 * max(value, 0.0) / full)] for value in shown).rjust(width)


def plot(values_n: Sequence[float], width: int, rows: int, ceiling_n: float | None = None) -> Content:
    """The newest forces as columns over several rows, with an axis; a dashed line where the ceiling is on the scale."""
    columns = max(width - AXIS, 0)
    shown = values_n[-columns:] if columns else ()
    full = scale_n(shown)
    heights = [round(8 * rows * max(value, 0.0) / full) for value in shown]
    at_ceiling = None if ceiling_n is None or ceiling_n > full else min(int(rows * ceiling_n / full), rows - 1)
    lines: list[Content] = []
    for row in range(rows - 1, -1, -1):
        text = "".join(EIGHTHS[min(max(height - 8 * row, 0), 8)] for height in heights).rjust(columns)
        if row == at_ceiling:
            text = text.replace(" ", CEILING)
        label = f"{full:g} N" if row == rows - 1 else "0 N" if row == 0 else ""
        tick = "┤" if label else "│"
        lines.append(Content.assemble((f"{label:>{AXIS - 1}}{tick}", "dim"), text))
    return Content("\n").join(lines)


def plot_title(ceiling_n: float | None) -> str:
    """What the plot shows, and where the arm is stopped."""
    ceiling = "" if ceiling_n is None else f", the arm stops above {ceiling_n:g} N"
    return f"Force: peak of each 0.1 s{ceiling}"
