"""Values as text: positions, times, bars and traces; and text from outside made harmless."""

from __future__ import annotations

import math
from collections.abc import Sequence

from textual.content import Content

from sessions import terminal

FULL, EMPTY = "█", "░"
EIGHTHS = " ▁▂▃▄▅▆▇█"
LEAST_SPAN_N = 0.01
"""Smallest full scale of a force trace, so that noise alone does not fill it."""
SOFTWARE_STOP = "s is a software stop. The red button is the emergency stop."
SHORT_STOP = "s: software stop; red button: emergency stop"


def plain(text: str) -> str:
    """Escape every character that a terminal acts on; a device's reply may hold an escape code."""
    return terminal.plain(text, keep="\n")


def one_line(text: str) -> str:
    """The same text on one line."""
    return plain(" ".join(text.split()))


def bar_text(done: int, planned: int, width: int) -> str:
    """`███░░░  3/6  50 %`; full only when all is done."""
    share = min(done / planned, 1.0) if planned else 0.0
    full = int(share * width)
    return f"{FULL * full}{EMPTY * (width - full)}  {done}/{planned}  {int(share * 100)} %"


def tip_text(tip_mm: tuple[float, float, float] | None) -> str:
    """The tip's position, or `no pose`."""
    if tip_mm is None:
        return "no pose"
    x, y, z = tip_mm
    return f"x {x:7.2f}  y {y:7.2f}  z {z:7.2f} mm"


def spark(values_n: Sequence[float], width: int) -> str:
    """The newest forces in one row, the largest as a full block."""
    shown = values_n[-width:] if width > 0 else ()
    top = max([LEAST_SPAN_N, *shown])
    return "".join(EIGHTHS[math.ceil(8 * max(value, 0.0) / top)] for value in shown).rjust(width)


def plot(values_n: Sequence[float], width: int, rows: int) -> Content:
    """The newest forces as columns over several rows, the largest as a full column."""
    shown = values_n[-width:] if width > 0 else ()
    top = max([LEAST_SPAN_N, *shown])
    heights = [round(8 * rows * max(value, 0.0) / top) for value in shown]
    lines: list[str] = []
    for base in range(8 * (rows - 1), -1, -8):
        lines.append("".join(EIGHTHS[min(max(height - base, 0), 8)] for height in heights).rjust(width))
    return Content("\n".join(lines))


def force_bar(force_n: float | None, full_n: float, width: int) -> str:
    """`███▌    0.123 N`; the bar is full at `full_n`."""
    if force_n is None:
        return "no force sensor"
    filled = min(max(force_n / full_n, 0.0), 1.0) * width if full_n > 0 else 0.0
    whole, part = divmod(round(8 * filled), 8)
    bar = FULL * whole + ("▏▎▍▌▋▊▉"[part - 1] if part else "")
    return f"{bar.ljust(width, EMPTY)} {force_n:7.3f} N"
