"""A whole plan: every step in order with its place, ink and time; and the tables that show it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter
from rich.console import Group
from rich.table import Table
from rich.text import Text

from brushloop.collect.errors import StepError
from brushloop.collect.motion import Path, park_moves
from brushloop.collect.planning.walk import StepMoves, Walked, placed_steps, sheet_of, walk
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.kinds import ReplayConfig, WriteConfig
from brushloop.collect.protocols.steps import MARKING, DrawStep, PressStep, SelfCheckStep, TouchStep
from brushloop.collect.rig.config import BrushConfig, RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import Patch, Sheet
from brushloop.collect.touch.selfcheck import triangle_in
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance
from brushloop.drivers.limits import Limits
from brushloop.model.ccdbsm import basic_lengths
from brushloop.sessions.events import Press
from brushloop.sessions.records import Condition

SETTLE_S = 0.12
"""Time from the end of a ramp to the next command: the controller's lag in reporting rest, half a poll, the calls.
Measured on the loopback rig; for a real controller it is not known."""
FRAME_S = 0.1
"""Period of 10 frames a second: a photograph is the second frame that begins after the arm rests."""
IN_PLACE_MM = 1.0
"""For a line shorter than this, ARCS reads the speed as that of the rotation: mm/s as thousandths of rad/s."""
OMITTED = (
    "connecting, power on, doses of ink, touches that measure the height, quality checks, writing to disk, "
    "sheet changes, pauses, and repeated presses"
)


def trapezoid_s(way: float, speed: float, acc: float) -> float:
    """Seconds of a trapezoidal speed profile from rest to rest; triangular if the speed is not reached."""
    return way / speed + speed / acc if way * acc >= speed * speed else 2.0 * math.sqrt(way / acc)


def move_s(start: Pose, target: Pose, speed_mm_s: float, acc_mm_s2: float, limits: Limits) -> float:
    """Seconds of a straight line, rest to rest, slower where the tool turns; a turn on the spot counts in rad."""
    travel_mm, turn_deg = distance(start, target)
    if travel_mm < IN_PLACE_MM and turn_deg > 0.01:
        return trapezoid_s(math.radians(turn_deg), speed_mm_s / 1e3, acc_mm_s2 / 1e3)
    if turn_deg > 0.01:
        speed_mm_s = limits.turn_capped(start, target, speed_mm_s)
    return trapezoid_s(travel_mm, speed_mm_s, acc_mm_s2)


def path_s(start: Pose, path: Path, acc_mm_s2: float, limits: Limits) -> float:
    """Seconds through poses without a halt: each line at its speed, one ramp up and one down; corners cost nothing."""
    total_s, before = path.speed_mm_s / acc_mm_s2, start
    for pose in path.poses:
        total_s += math.dist(before.position_mm, pose.position_mm) / limits.turn_capped(before, pose, path.speed_mm_s)
        before = pose
    return total_s


def step_s(config: RigConfig, here: Pose, moves: StepMoves) -> tuple[float, Pose]:
    """(seconds of a step that begins at `here`, pose at its end)."""
    limits, acc_mm_s2 = limits_of(config), config.motion.acc_mm_s2
    total_s = moves.dwell_s + moves.captures * (config.camera.latency_ms / 1e3 + FRAME_S)
    for segment in moves.segments:
        if isinstance(segment, Path):
            total_s += path_s(here, segment, acc_mm_s2, limits)
            here = segment.poses[-1]
        else:
            # Of a region one descent: the number of descents of a measured touch is not known beforehand.
            total_s += move_s(here, segment.poses[0], segment.speed_mm_s, acc_mm_s2, limits)
            here = segment.poses[0]
        total_s += SETTLE_S
    return total_s, here


HELD_SHARE = 0.3
"""Share of a wet bundle's volume that is ink between the hairs. Assumed: weigh a dipped brush to know it."""


@dataclass(frozen=True, slots=True)
class InkNeed:
    """Upper estimate of the ink, and what it is based on."""

    ml: float
    why: str


def bundle_ml(brush: BrushConfig) -> float:
    """Volume of the bundle as a cone of its largest radius and its length."""
    return math.pi * brush.radius_mm**2 * brush.length_mm / 3.0 / 1e3


def ink_need(config: RigConfig, dips: int) -> InkNeed:
    """Count a full load per dip, as if each mark emptied the brush; for a pump that doses by count, its doses."""
    device = config.ink.device
    if device is not None and (doses_ml := device.doses_ml(dips)) is not None:
        return InkNeed(doses_ml, f"what the {device.kind} doses in {dips} dips")
    load_ml = HELD_SHARE * bundle_ml(config.brush)
    return InkNeed(
        dips * load_ml,
        f"at most: every dip takes {load_ml:.2f} ml, {HELD_SHARE:.0%} of the bundle's volume (assumed)",
    )


@dataclass(frozen=True, slots=True)
class Reach:
    """How far a mark reaches from its zero-touch point: along the heading, against it, and to either side."""

    ahead_mm: float
    behind_mm: float
    side_mm: float


def reach_of(brush: BrushConfig, condition: Condition) -> Reach:
    """Estimate by the stroke model as published (Eq. 1-5, lambda = pi): good for a warning, not a measurement."""
    depth_mm, alpha = max(condition.depth_mm, 0.0), math.radians(condition.tilt_deg)
    o3a, o3c, o4o3 = basic_lengths(depth_mm, alpha, brush.radius_mm, brush.length_mm, math)
    return Reach(o3a, o4o3, math.pi * o3c)


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
        if isinstance(step, PressStep | DrawStep):
            if placed and walked.sheet != sheets:
                changes.append(step.press.stroke_id)
            sheets = walked.sheet
            placed.append(step.press.model_copy(update={"sheet": sheets - 1, "patch": walked.patches[0].index}))
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
    over_s, _ = step_s(config, here, StepMoves(walked.moves.segments[:1]))
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
    (before, _), (sheets, taken) = (_sheets(rig, protocol) for rig in (config, armed))
    if sheets == before:
        return None
    patches = f"{taken} patches" if taken > 1 else "one patch"
    return (
        f"with --arm the self-check first takes {patches}: {sheets} sheets instead of {before} (`collect plan --arm`)"
    )


def _sheets(config: RigConfig, protocol: ProtocolConfig) -> tuple[int, int]:
    """(sheets that are marked, patches of the first sheet that the self-check takes)."""
    sheets, taken = 1, 0
    for placed in placed_steps(config, protocol):
        if placed.step.kind in MARKING:
            sheets = placed.sheet
        if isinstance(placed.step, SelfCheckStep):
            taken = len(placed.patches)
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
    overhangs: dict[Condition, tuple[float, str]] = {}
    for stroke in protocol.planned():
        reach = reach_of(config.brush, stroke.condition)
        beyond_mm = max(
            reach.behind_mm - anchor_x,
            anchor_x + reach.ahead_mm - patch.size_x_mm,
            reach.side_mm - min(anchor_y, patch.size_y_mm - anchor_y),
        )
        overhangs.setdefault(stroke.condition, (beyond_mm, stroke.stroke_id))
    return list(overhangs.values())


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
