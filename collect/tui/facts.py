"""The lines of figures beside the state: step, strokes, time, counts, tip, target, force."""

from __future__ import annotations

import math

from rich.cells import cell_len
from textual.content import Content

from collect.engine.snapshot import Snapshot
from collect.engine.states import FINAL
from collect.headless import eta_text, no_pose_text
from collect.tui.text import bar_text, minutes_text, one_line, tip_text
from collect.tui.trace import spark

LABEL = 9


def facts_content(now: Snapshot, width: int) -> Content:
    """Seven lines for a width."""
    rows = (
        ("Step", one_line(now.step) or "-", "bold"),
        ("Strokes", _strokes(now, width), ""),
        ("Time", _time(now), ""),
        ("Counts", *_counts(now)),
        ("Tip", no_pose_text(now) or tip_text(now.tip_mm), "" if now.tip_mm else "bold $text-warning"),
        ("Target", target_text(now), ""),
        ("Force", _force(now, width - LABEL), ""),
    )
    lines = [Content.assemble((label.ljust(LABEL), "dim"), (text, style)) for label, text, style in rows]
    return Content("\n").join(lines)


def _strokes(now: Snapshot, width: int) -> str:
    counts = bar_text(now.strokes_done, now.strokes_planned, 0)
    return bar_text(now.strokes_done, now.strokes_planned, max(width - LABEL - cell_len(counts) - 1, 4))


def _time(now: Snapshot) -> str:
    time = f"elapsed {minutes_text(now.elapsed_s)}"
    if now.state in FINAL:
        return time
    left = max(now.strokes_planned - now.strokes_done - now.given_up, 0)
    return f"{time}   {eta_text(now) or 'no ETA yet'}   {left} strokes left"


def _counts(now: Snapshot) -> tuple[str, str]:
    parts = [f"voids {now.voids}"]
    if now.given_up:
        parts.append(f"left out {now.given_up}")
    parts.append("ink not gauged" if now.ink_level is None else f"ink {now.ink_level:.0%} of the well")
    return "   ".join(parts), "bold $text-warning" if now.voids or now.given_up else ""


def target_text(now: Snapshot) -> str:
    """Where the arm was sent, and how far that is from where it is."""
    if now.target_mm is None:
        return "not sent anywhere yet"
    if now.tip_mm is None:
        return tip_text(now.target_mm)
    return f"{tip_text(now.target_mm)}   {math.dist(now.target_mm, now.tip_mm):.2f} mm to go"


def _force(now: Snapshot, room: int) -> str:
    if now.force_n is None:
        return "not measured now" if now.state in FINAL else "no force sensor, or silent"
    told = f"{now.force_n:6.3f} N  "
    return told + spark(now.trace_n, max(0, min(room - len(told), 60)))
