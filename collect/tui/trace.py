"""Force as a bar and as a trace of blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from textual.content import Content

EIGHTHS = " ▁▂▃▄▅▆▇█"
LEAST_SPAN_N = 0.01
"""A trace of noise alone shall not fill its place."""


def spark(values: Sequence[float], width: int) -> str:
    """The newest values in one row, the largest of them as a full block."""
    shown = values[-width:] if width > 0 else ()
    top = max([LEAST_SPAN_N, *shown])
    return "".join(EIGHTHS[math.ceil(8 * max(value, 0.0) / top)] for value in shown).rjust(width)


def plot(values: Sequence[float], width: int, rows: int) -> Content:
    """The newest values as columns over several rows, with the largest named."""
    shown = values[-width:] if width > 0 else ()
    top = max([LEAST_SPAN_N, *shown])
    heights = [round(8 * rows * max(value, 0.0) / top) for value in shown]
    lines: list[str] = []
    for row in range(rows, 0, -1):
        base = 8 * (row - 1)
        lines.append("".join(EIGHTHS[min(max(height - base, 0), 8)] for height in heights).rjust(width))
    return Content("\n".join(lines))


def force_bar(force_n: float | None, full_n: float, width: int) -> str:
    """`███▌    0.123 N`; the scale ends at `full_n`."""
    if force_n is None:
        return "no force sensor"
    filled = min(max(force_n / full_n, 0.0), 1.0) * width if full_n > 0 else 0.0
    whole, part = divmod(round(8 * filled), 8)
    bar = "█" * whole + ("▏▎▍▌▋▊▉"[part - 1] if part else "")
    return f"{bar.ljust(width, '░')} {force_n:7.3f} N"
