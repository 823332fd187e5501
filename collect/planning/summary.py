"""A whole plan: every step in order with its place, ink and time; and the tables that show it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter
from rich.console import Group
from rich.table import Table
from rich.text import Text

from brushloop.collect.errors import StepError
from brushloop.collect.motion.moves import park_moves
from brushloop.collect.planning.estimate import OMITTED, InkNeed, ink_need, reach_of, step_s
from brushloop.collect.planning.walk import StepMoves, Walked, sheet_of, walk
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.presses import ReplayConfig
from brushloop.collect.protocols.steps import MARKING, DrawStep, PressStep, SelfCheckStep, TouchStep
from brushloop.collect.protocols.write import WriteConfig
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.paper import Patch, Sheet
from brushloop.collect.touch.selfcheck import triangle_in
from brushloop.drivers.devices import Pose
from brushloop.sessions.events import Press
from brushloop.sessions.records import Condition


@dataclass(frozen=True, slots=True)
class Plan:
    """Steps, strokes, sheets, ink and time of a protocol."""

    kind: str
    steps: dict[str, int]
    """Number of steps of each kind."""
    placed: tuple[Press, ...]
    """Every press or figure in order, on its sheet and patch."""
    patches_per_sheet: int
    sheets: int
    sheet_changes: tuple[str, ...]
    """Strokes before which a fresh sheet goes in."""
    dips: int
    ink: InkNeed
    poses: int
    seconds: float
    seconds_by_kind: dict[str, float]
    touches_mm: tuple[tuple[float, float], ...]
    """Touch points in the paper frame, those of zero touch first."""
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return every field, to be written as JSON."""
        return TypeAdapter(Plan).dump_python(self, mode="json", exclude_none=True) | {"seconds_omit": OMITTED}


def make_plan(config: RigConfig, protocol: ProtocolConfig) -> Plan:
    """Walk the protocol and add up strokes, sheets, ink and time. `check_protocol` must have passed."""
    sheet = sheet_of(config, protocol)
    placed: list[Press] = []
    changes: list[str] = []
    kinds: Counter[str] = Counter()
    seconds: dict[str, float] = {}
    measured = config.touch.method != "taught" and config.touch.points_mm
    touches = list(measured or [config.paper.touch_point_mm])
    dips = poses = 0
    sheets = 1
    here = park_moves(config)[-1].target
    for walked in walk(config, protocol):
        step = walked.step
        kind = str(step.kind)
        kinds[kind] += 1
        wait_s = _wait_s(config, protocol, here, walked)
        took_s, here = step_s(config, here, walked.moves)
        took_s += wait_s
        seconds[kind] = seconds.get(kind, 0.0) + took_s
        dips += walked.moves.dips
        poses += len(walked.moves.poses)
        if isinstance(step, TouchStep):
            touches.append((step.x_mm, step.y_mm))
        if isinstance(step, PressStep | DrawStep) and walked.patch is not None:
            if placed and walked.sheet != sheets:
                changes.append(step.press.stroke_id)
            sheets = walked.sheet
            placed.append(step.press.model_copy(update={"sheet": sheets - 1, "patch": walked.patch.index}))
    return Plan(
        kind=protocol.kind,
        steps=dict(kinds),
        placed=tuple(placed),
        patches_per_sheet=sheet.capacity,
        sheets=sheets,
        sheet_changes=tuple(changes),
        dips=dips,
        ink=ink_need(config, dips),
        poses=poses,
        seconds=sum(seconds.values()),
        seconds_by_kind=seconds,
        touches_mm=tuple(dict.fromkeys(touches)),
        warnings=tuple(_warnings(config, protocol, sheet)),
    )


def _wait_s(config: RigConfig, protocol: ProtocolConfig, here: Pose, walked: Walked) -> float:
    """Seconds that the arm waits over the patch for the ink; of a figure, before its first stroke."""
    if protocol.wait_after_dip_s is None or not isinstance(walked.step, PressStep | DrawStep):
        return 0.0
    over_s, _ = step_s(config, here, StepMoves(walked.moves.parts[:1]))
    return max(0.0, protocol.wait_after_dip_s - over_s)


def _warnings(config: RigConfig, protocol: ProtocolConfig, sheet: Sheet) -> list[str]:
    warnings: list[str] = []
    if isinstance(protocol, ReplayConfig) and protocol.ignored_columns:
        warnings.append(f"{protocol.file}: columns that are not used: {', '.join(protocol.ignored_columns)}")
    if (added := _armed(config, protocol)) is not None:
        warnings.append(added)
    over_mm, worst = max(_overhangs(config, protocol, sheet), default=(0.0, ""))
    if over_mm > 0.0:
        warnings.append(
            f"{worst} may reach {over_mm:.1f} mm beyond its patch of {sheet.cell_mm[0]:g} x {sheet.cell_mm[1]:g} mm, "
            "by the closed-form stroke model: marks may run into each other"
        )
    return warnings


def _armed(config: RigConfig, protocol: ProtocolConfig) -> str | None:
    """Warning about what the self-check, which `--arm` switches on, adds to this plan; None if it adds nothing."""
    if config.self_check.enabled is not None or not protocol.planned():
        return None
    armed = config.checking_itself(True)
    try:
        triangle_in(sheet_of(armed, protocol).patch(0), armed.self_check)
    except StepError as error:
        return f"with --arm the self-check comes first, and {error}: change [self_check] legs_mm, or enabled = false"
    (before, _), (sheets, taken) = (_sheets(one, protocol) for one in (config, armed))
    if sheets == before:
        return None
    patches = f"{taken} patches" if taken > 1 else "one patch"
    return (
        f"with --arm the self-check first takes {patches}: {sheets} sheets instead of {before} (`collect plan --arm`)"
    )


def _sheets(config: RigConfig, protocol: ProtocolConfig) -> tuple[int, int]:
    """(sheets that are marked, patches of the first sheet that the self-check takes)."""
    sheets, taken = 1, 0
    for walked in walk(config, protocol):
        if walked.patch is not None and walked.step.kind in MARKING:
            sheets = walked.sheet
        if isinstance(walked.step, SelfCheckStep):
            taken = 1 + len(walked.more_patches)
    return sheets, taken


def _overhangs(config: RigConfig, protocol: ProtocolConfig, sheet: Sheet) -> list[tuple[float, str]]:
    """(mm beyond the patch, stroke id) of every distinct press or figure."""
    if not sheet.capacity:
        return []
    patch = sheet.patch(0)
    if isinstance(protocol, WriteConfig):
        return [
            (max(_figure_overhang(config, patch, point) for s in figure.strokes for point in s.points), figure.name)
            for figure in protocol.figures
        ]
    anchor_x, anchor_y = patch.anchor_mm[0] - patch.x_mm, patch.anchor_mm[1] - patch.y_mm
    found: dict[Condition, tuple[float, str]] = {}
    for stroke in protocol.planned():
        reach = reach_of(config.brush, stroke.condition)
        beyond_mm = max(
            reach.behind_mm - anchor_x,
            anchor_x + reach.ahead_mm - patch.size_x_mm,
            reach.side_mm - min(anchor_y, patch.size_y_mm - anchor_y),
        )
        found.setdefault(stroke.condition, (beyond_mm, stroke.stroke_id))
    return list(found.values())


def _figure_overhang(config: RigConfig, patch: Patch, point: tuple[float, float, float, float, float]) -> float:
    """How far the line, half its width to either side of a drawn point, reaches beyond the patch."""
    x_mm, y_mm, depth_mm, tilt_deg, _ = point
    side_mm = reach_of(config.brush, Condition(depth_mm, tilt_deg)).side_mm
    return side_mm - min(x_mm, y_mm, patch.size_x_mm - x_mm, patch.size_y_mm - y_mm)


MOST_ROWS = 40
"""Most rows of (H, alpha); nobody would read more."""


def plan_table(plan: Plan) -> Group:
    """Return the plan's totals, what is pressed where, and its warnings, as tables and text."""
    totals = Table(title=f"plan of {plan.kind}", show_header=False)
    changes = f", a fresh one before {', '.join(plan.sheet_changes)}" if plan.sheet_changes else ""
    totals.add_row("strokes", str(len(plan.placed)))
    totals.add_row(
        "sheets", f"{plan.sheets} of {plan.patches_per_sheet} patches{changes}" if plan.placed else "no marks"
    )
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
    """Hours and minutes, or minutes and seconds, as text."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def _conditions(plan: Plan) -> Table:
    table = Table("H mm", "alpha deg", "strokes", "on each sheet")
    counts = Counter((press.condition, press.sheet) for press in plan.placed)
    conditions = sorted({press.condition for press in plan.placed})
    for asked in conditions[:MOST_ROWS]:
        by_sheet = [counts[asked, sheet] for sheet in range(plan.sheets)]
        sheets = " ".join(map(str, by_sheet[:20]))
        table.add_row(f"{asked.depth_mm:g}", f"{asked.tilt_deg:g}", str(sum(by_sheet)), sheets)
    if len(conditions) > MOST_ROWS:
        table.add_row("...", "...", f"{len(conditions) - MOST_ROWS} more", "")
    return table
