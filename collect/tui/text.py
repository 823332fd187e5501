"""Words for the screen: everything that came from outside is made plain first."""

from __future__ import annotations

FULL, EMPTY = "█", "░"
SOFTWARE_STOP = "s is a software stop. The red button is the emergency stop."

SHORT_STOP = "s: software stop; red button: emergency stop"


def plain(text: str) -> str:
    """The text without characters that a terminal would act on; a device's reply may hold an escape sequence."""
    return "".join(char if char.isprintable() or char == "\n" else "\N{REPLACEMENT CHARACTER}" for char in text)


def one_line(text: str) -> str:
    """The same, for a place that has one row."""
    return plain(" ".join(text.split()))


def bar_text(done: int, planned: int, width: int) -> str:
    """`███░░░  3/6  50 %`; full only when all is done."""
    share = min(done / planned, 1.0) if planned else 0.0
    full = int(share * width)
    return f"{FULL * full}{EMPTY * (width - full)}  {done}/{planned}  {int(share * 100)} %"


def minutes_text(seconds: float) -> str:
    """`12:05`, as `eta_text` writes it."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def tip_text(tip_mm: tuple[float, float, float] | None) -> str:
    """The tip's position, or `no pose`."""
    if tip_mm is None:
        return "no pose"
    x, y, z = tip_mm
    return f"x {x:7.2f}  y {y:7.2f}  z {z:7.2f} mm"
