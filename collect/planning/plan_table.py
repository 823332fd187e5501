"""A plan as tables for people."""

from __future__ import annotations

from collections import Counter

from rich.console import Group
from rich.table import Table
from rich.text import Text

from collect.planning.summary import Plan
from collect.planning.timing import OMITTED

MOST_ROWS = 40
"""(H, alpha) in the table; more would not be read."""


def plan_table(plan: Plan) -> Group:
    """What it takes, what is pressed where, and what should be looked at."""
    totals = Table(title=f"plan of {plan.kind}", show_header=False)
    changes = f", a fresh one before {', '.join(plan.sheet_changes)}" if plan.sheet_changes else ""
    totals.add_row("strokes", str(len(plan.placed)))
    totals.add_row("sheets", f"{plan.sheets} of {plan.cells_per_sheet} cells{changes}" if plan.placed else "no marks")
    totals.add_row("dips", str(plan.dips))
    totals.add_row("ink", f"{plan.ink.ml:.1f} ml, {plan.ink.why}" if plan.dips else "none")
    totals.add_row("steps", ", ".join(f"{count} {kind}" for kind, count in plan.steps.items()))
    totals.add_row("time", f"{duration(plan.seconds)}, not counting {OMITTED}")
    for kind, seconds in plan.seconds_by_kind.items():
        totals.add_row(f"  {kind}", duration(seconds))
    parts: list[Table | Text] = [totals]
    if plan.placed:
        parts.append(_conditions(plan))
    parts += [Text(f"warning: {warning}", style="yellow") for warning in plan.warnings]
    return Group(*parts)


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, in words."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def _conditions(plan: Plan) -> Table:
    table = Table("H mm", "alpha deg", "strokes", "on each sheet")
    counts = Counter((p.height_mm, p.tilt_deg, p.sheet) for p in plan.placed)
    cells = sorted({(p.height_mm, p.tilt_deg) for p in plan.placed})
    for height_mm, tilt_deg in cells[:MOST_ROWS]:
        by_sheet = [counts[height_mm, tilt_deg, sheet] for sheet in range(1, plan.sheets + 1)]
        table.add_row(f"{height_mm:g}", f"{tilt_deg:g}", str(sum(by_sheet)), " ".join(map(str, by_sheet[:20])))
    if len(cells) > MOST_ROWS:
        table.add_row("...", "...", f"{len(cells) - MOST_ROWS} more", "")
    return table
