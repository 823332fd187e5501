"""Values as text: positions and bars; and text from outside made harmless."""

from __future__ import annotations

from brushloop.collect.tui.force_text import EMPTY, FULL
from brushloop.sessions import terminal
from brushloop.sessions.records import Condition

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
