"""A picture of a plan: the rig from above, then each sheet with its strokes and touch points."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

from brushloop.collect.planning.summary import Plan
from brushloop.collect.planning.walk import sheet_of
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.steps import Drawn
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.paper import Sheet, to_base
from brushloop.collect.rig.show import BLUE, GREY, ORANGE, Axes, finish, from_above, shown_name
from brushloop.collect.touch.selfcheck import partners

MOST_SHEETS = 11
"""Most sheets drawn: with the view of the whole table, twelve panels."""


def draw_plan(config: RigConfig, protocol: ProtocolConfig, plan: Plan, path: Path) -> None:
    """Write the picture, in the format of the file's ending. `collect.rig.show.check_picture` must have passed.

    Raises OSError if it cannot be written.
    """
    from matplotlib.figure import Figure as Picture

    shown = min(plan.sheets, MOST_SHEETS) if plan.placed else 0
    columns = 1 if shown == 0 else 2 if shown < 6 else 3
    rows = math.ceil((shown + 1) / columns)
    width, height = config.paper.size_mm
    panel_in = 7.2
    picture: Any = Picture(
        figsize=(panel_in * columns, (panel_in * height / width + 0.35) * rows), layout="constrained"
    )
    axes: list[Axes] = list(picture.subplots(rows, columns, squeeze=False).flat)
    sheet = sheet_of(config, protocol)
    from_above(axes[0], config)
    touched = [to_base(config.paper, *at) for at in plan.touches_mm]
    axes[0].plot(*zip(*touched, strict=True), "x", color=ORANGE, markersize=9, mew=2.0)
    axes[0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=4, frameon=False)
    drawn = {p.stroke_id: p.drawn for p in protocol.planned() if p.drawn is not None}
    for number, panel in enumerate(axes[1 : shown + 1], 1):
        _sheet(panel, config, sheet, number, plan, drawn)
    for panel in axes[shown + 1 :]:
        panel.set_axis_off()
    if plan.sheets > shown > 0:
        picture.suptitle(f"the first {shown} of {plan.sheets} sheets")
    picture.savefig(path, dpi=110)


def _sheet(
    axes: Axes,
    config: RigConfig,
    sheet: Sheet,
    number: int,
    plan: Plan,
    drawn: dict[str, Drawn],
) -> None:
    from matplotlib import colormaps

    depths_mm = [press.condition.depth_mm for press in plan.placed]
    low, high = min(depths_mm), max(depths_mm)
    axes.add_patch(_outline((0.0, 0.0, *config.paper.size_mm), "black"))
    placed = [(order, press) for order, press in enumerate(plan.placed, 1) if press.sheet == number - 1]
    for order, press in placed:
        assert press.patch is not None
        patch, asked, figure = sheet.patch(press.patch), press.condition, drawn.get(press.stroke_id)
        share = 0.5 if high == low else (asked.depth_mm - low) / (high - low)
        shade = colormaps["cividis"](0.25 + 0.75 * (1.0 - share))
        axes.add_patch(_outline(patch.rect_mm, GREY, shade if figure is None else None))
        ink = "white" if figure is None and 0.25 + 0.75 * (1.0 - share) < 0.55 else "black"
        points = max(4.0, min(0.34 * patch.size_y_mm, 0.17 * patch.size_x_mm) * 498.0 / config.paper.size_mm[0])
        if figure is not None:
            _figure(axes, patch.rect_mm, figure)
            axes.text(patch.x_mm + 1.0, patch.y_mm + 1.0, f"#{order} {shown_name(press.stroke_id)}", fontsize=8)
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
            axes.add_patch(_outline(patch.rect_mm, GREY))
            axes.text(patch.x_mm + 2.0, patch.y_mm + 0.5 * patch.size_y_mm, "self-check", fontsize=8, va="center")
    axes.plot(*zip(*plan.touches_mm, strict=True), "x", color=ORANGE, markersize=7, mew=2.0)
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


def _outline(rect_mm: tuple[float, float, float, float], edge: str, face: object = None) -> Any:
    from matplotlib.patches import Rectangle

    x_mm, y_mm, size_x_mm, size_y_mm = rect_mm
    return Rectangle((x_mm, y_mm), size_x_mm, size_y_mm, edgecolor=edge, facecolor=face or "none", linewidth=0.8)
