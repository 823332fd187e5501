"""A whole plan: every step in order with its place, ink and time; and the tables and the picture that show it."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from rich.table import Table

from brushloop.calibrate.report import picture_grid, printable
from brushloop.collect.motion import Move, Region, park_move
from brushloop.collect.motion import Path as MotionPath
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.steps import Drawn, PressStep
from brushloop.collect.rig.check import BLUE, GREY, ORANGE, Axes, finish, from_above, outline
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import PaperPlane, Sheet
from brushloop.collect.touch.selfcheck import partners
from brushloop.collect.walk import StepMoves, moves_of, sheet_of, walk
from brushloop.drivers.arcs.motion import as_sent, durations_s
from brushloop.drivers.devices import Pose
from brushloop.drivers.limits import Limits
from brushloop.sessions.events import Press

SETTLE_S = 0.12
"""Time from the end of a ramp to the next command: the controller's lag in reporting rest, half a poll, the calls.
Measured on the loopback rig; for a real controller it is not known."""
FRAME_S = 0.1
"""Period of 10 frames a second: a photograph is the second frame that begins after the arm rests."""
OMITTED = (
    "connecting, power on, doses of ink, touches that measure the height, quality checks, writing to disk, "
    "sheet changes, pauses, and repeated presses"
)


def path_s(start: Pose, path: MotionPath, acc_mm_s2: float, limits: Limits) -> float:
    """Seconds through poses without a halt: each line at its speed, one ramp up and one down; corners cost nothing."""
    total_s, before = path.speed_mm_s / acc_mm_s2, start
    for pose in path.poses:
        total_s += math.dist(before.position_mm, pose.position_mm) / limits.turn_capped(before, pose, path.speed_mm_s)
        before = pose
    return total_s


def step_s(config: RigConfig, here: Pose, moves: StepMoves) -> tuple[float, Pose]:
    """(seconds of a step that begins at `here`, pose at its end)."""
    limits, acc_mm_s2 = limits_of(config), config.motion.acc_mm_s2
    total_s = moves.captures * (config.camera.latency_ms / 1e3 + FRAME_S)
    for segment in moves.segments:
        if isinstance(segment, Region):
            # One descent: the number of descents of a measured touch is not known beforehand.
            segment = Move(segment.poses[0], segment.speed_mm_s)
        if isinstance(segment, Move):
            total_s += sum(durations_s(here, as_sent(here, [segment], limits), acc_mm_s2))
            here = segment.target
        else:
            total_s += path_s(here, segment, acc_mm_s2, limits)
            here = segment.poses[-1]
        total_s += SETTLE_S
    return total_s, here


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
    ink_ml: float | None
    """What the ink device doses; None without a device that doses by count."""
    seconds: float
    seconds_by_kind: dict[str, float]


def make_plan(config: RigConfig, protocol: ProtocolConfig) -> Plan:
    """Walk the protocol and add up strokes, sheets, ink and time. `check_protocol` must have passed."""
    sheet = sheet_of(config, protocol)
    placed: list[Press] = []
    kinds: Counter[str] = Counter()
    seconds: dict[str, float] = {}
    dips = 0
    plane, here = PaperPlane(config.paper.touch_z_mm), park_move(config).target
    for walked in walk(config, protocol):
        step = walked.step
        kind, moves = str(step.kind), moves_of(config, plane, step, walked.patches, dips=dips)
        kinds[kind] += 1
        took_s, here = step_s(config, here, moves)
        seconds[kind] = seconds.get(kind, 0.0) + took_s
        dips += moves.dips
        if isinstance(step, PressStep):
            placed.append(step.press.model_copy(update={"sheet": walked.sheet - 1, "patch": walked.patches[0].index}))
    return Plan(
        kind=protocol.kind,
        steps=dict(kinds),
        placed=tuple(placed),
        patches_per_sheet=sheet.capacity,
        sheets=1 + max(press.sheet or 0 for press in placed),
        sheet_changes=tuple(b.stroke_id for a, b in itertools.pairwise(placed) if a.sheet != b.sheet),
        dips=dips,
        ink_ml=None if config.ink.device is None else config.ink.device.doses_ml(dips),
        seconds=sum(seconds.values()),
        seconds_by_kind=seconds,
    )


def plan_table(plan: Plan) -> Table:
    """Return the plan's totals, and how often each (H, alpha) is pressed, as a table."""
    totals = Table(title=f"plan of {plan.kind}", show_header=False)
    changes = f", a fresh one before {', '.join(plan.sheet_changes)}" if plan.sheet_changes else ""
    totals.add_row("strokes", str(len(plan.placed)))
    totals.add_row("sheets", f"{plan.sheets}, with {plan.patches_per_sheet} patches each{changes}")
    totals.add_row("dips", str(plan.dips))
    if plan.ink_ml is not None:
        totals.add_row("ink", f"{plan.ink_ml:.1f} ml, dosed by the ink device")
    totals.add_row("steps", ", ".join(f"{count} {kind}" for kind, count in plan.steps.items()))
    totals.add_row("time", f"{timedelta(seconds=round(plan.seconds))}, not counting {OMITTED}")
    for kind, seconds in plan.seconds_by_kind.items():
        totals.add_row(f"  {kind}", str(timedelta(seconds=round(seconds))))
    for condition, count in sorted(Counter(press.condition for press in plan.placed).items()):
        totals.add_row(f"H {condition.depth_mm:g} mm, alpha {condition.tilt_deg:g} deg", f"{count} strokes")
    return totals


MOST_SHEETS = 11
"""Most sheets drawn: with the view of the whole table, twelve panels."""


def draw_plan(config: RigConfig, protocol: ProtocolConfig, plan: Plan, path: Path) -> None:
    """Write the picture, in the format of the file's ending. Raises OSError if it cannot be written."""
    shown = min(plan.sheets, MOST_SHEETS)
    columns = 2 if shown < 6 else 3
    rows = math.ceil((shown + 1) / columns)
    width, height = config.paper.size_mm
    panel_in = 7.2
    title = f"the first {shown} of {plan.sheets} sheets" if plan.sheets > shown else ""
    size_in = panel_in * columns, (panel_in * height / width + 0.35) * rows
    picture, grid = picture_grid(rows, columns, size_in, title)
    axes: list[Axes] = list(grid.flat)
    sheet = sheet_of(config, protocol)
    from_above(axes[0], config)
    axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=4, frameon=False)
    drawn = {p.stroke_id: p.drawn for p in protocol.planned() if p.drawn is not None}
    for number, panel in enumerate(axes[1 : shown + 1], 1):
        _sheet(panel, config, sheet, number, plan, drawn)
    for panel in axes[shown + 1 :]:
        panel.set_axis_off()
    picture.savefig(path)


def _sheet(axes: Axes, config: RigConfig, sheet: Sheet, number: int, plan: Plan, drawn: dict[str, Drawn]) -> None:
    from matplotlib import colormaps

    depths_mm = [press.condition.depth_mm for press in plan.placed]
    low, high = min(depths_mm), max(depths_mm)
    outline(axes, (0.0, 0.0, *config.paper.size_mm), fill=False, edgecolor="black", linewidth=0.8)
    placed = [(order, press) for order, press in enumerate(plan.placed, 1) if press.sheet == number - 1]
    for order, press in placed:
        assert press.patch is not None
        patch, asked, figure = sheet.patch(press.patch), press.condition, drawn.get(press.stroke_id)
        share = 0.5 if high == low else (asked.depth_mm - low) / (high - low)
        shade = colormaps["cividis"](0.25 + 0.75 * (1.0 - share))
        outline(axes, patch.rect_mm, fill=figure is None, edgecolor=GREY, facecolor=shade, linewidth=0.8)
        ink = "white" if figure is None and 0.25 + 0.75 * (1.0 - share) < 0.55 else "black"
        points = max(4.0, min(0.34 * patch.size_y_mm, 0.17 * patch.size_x_mm) * 498.0 / config.paper.size_mm[0])
        if figure is not None:
            _figure(axes, patch.rect_mm, figure)
            axes.text(patch.x_mm + 1.0, patch.y_mm + 1.0, f"#{order} {printable(press.stroke_id)}", fontsize=8)
        else:
            axes.text(
                patch.x_mm + 0.36 * patch.size_x_mm,
                patch.y_mm + 0.5 * patch.size_y_mm,
                f"#{order}\nH{asked.depth_mm:g} a{asked.tilt_deg:g}",
                fontsize=min(points, 9.0),
                color=ink,
                ha="center",
                va="center",
            )
            axes.plot(*patch.anchor_mm, "+", color=ink, markersize=5, alpha=0.7)
    if number == 1 and plan.steps.get("self_check"):
        first = sheet.patch(0)
        for patch in (first, *partners(sheet, first, set())):
            outline(axes, patch.rect_mm, fill=False, edgecolor=GREY, linewidth=0.8)
            axes.text(patch.x_mm + 2.0, patch.y_mm + 0.5 * patch.size_y_mm, "self-check", fontsize=8, va="center")
    touched_mm = config.touch.points_mm or [config.paper.touch_point_mm]
    axes.plot(*zip(*touched_mm, strict=True), "x", color=ORANGE, markersize=7, mew=2.0)
    axes.set_xlim(-3.0, config.paper.size_mm[0] + 3.0)
    axes.set_ylim(-3.0, config.paper.size_mm[1] + 3.0)
    note = "" if drawn else ": # order, H mm, a deg; darker is deeper; + where the tip meets the paper"
    finish(axes, f"sheet {number}, {len(placed)} strokes{note}")


def _figure(axes: Axes, rect_mm: tuple[float, float, float, float], figure: Drawn) -> None:
    """Trajectories, thicker where deeper, with a ring where each stroke begins."""
    x_mm, y_mm, *_ = rect_mm
    for number, stroke in enumerate(figure.strokes, 1):
        for a, b in itertools.pairwise(stroke):
            thick = 0.6 + 0.25 * max(0.0, 0.5 * (a[2] + b[2]))
            axes.plot([x_mm + a[0], x_mm + b[0]], [y_mm + a[1], y_mm + b[1]], color=BLUE, lw=thick, alpha=0.75)
        first = stroke[0]
        axes.plot(x_mm + first[0], y_mm + first[1], "o", mfc="white", mec=ORANGE, markersize=9)
        axes.text(x_mm + first[0], y_mm + first[1], str(number), fontsize=6, ha="center", va="center")
