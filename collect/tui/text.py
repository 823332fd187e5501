"""Values as text: positions, bars, and forces as blocks and plots; and text from outside made harmless.

Every scale of a force is a round number of newtons.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from textual.content import Content

from brushloop.sessions import terminal
from brushloop.sessions.records import Condition

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


def age_text(age_s: float) -> str:
    """`just now`, `20 s ago`, `5 min ago`, `2 h ago`: coarse, so that it changes seldom."""
    if age_s < 10.0:
        return "just now"
    if age_s < 60.0:
        return f"{10 * int(age_s / 10.0)} s ago"
    return f"{int(age_s / 60.0)} min ago" if age_s < 3600.0 else f"{int(age_s / 3600.0)} h ago"


def condition_text(condition: Condition) -> str:
    """`H 13 mm  α 5°`."""
    return f"H {condition.depth_mm:g} mm  α {condition.tilt_deg:g}°"


def tip_text(tip_mm: tuple[float, float, float] | None) -> str:
    """The tip's position, or `no pose`."""
    if tip_mm is None:
        return "no pose"
    x, y, z = tip_mm
    return f"x {x:7.2f}  y {y:7.2f}  z {z:7.2f} mm"
