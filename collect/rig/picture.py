"""A picture of the rig in the base frame, from above and from the side: reach, box, sheet, board, and every place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from collect.rig.config import RigConfig
from collect.rig.devices import limits_of
from collect.rig.drawing import BLUE, GREEN, GREY, ORANGE, PAPER, Axes, finish
from collect.rig.paper import to_base
from collect.rig.places import Kind, Place, places_of
from collect.rig.reach import Ring, tool_of, upright_ring

MARKS: dict[Kind, tuple[str, str, str]] = {
    "well": ("o", BLUE, "well"),
    "rim": ("v", BLUE, "wipe, over the rim"),
    "pot": ("s", BLUE, "wash pot"),
    "park": ("^", GREEN, "park"),
    "touch": ("x", ORANGE, "touch point"),
}
"""Marker, colour and name in the legend; the sheet is drawn as an area."""
MARGIN_MM = 60.0
HEIGHTS = 60
"""Heights at which the reach is drawn."""


def draw_rig(config: RigConfig, path: Path) -> None:
    """Write the picture, in the format of the file's ending. `collect.rig.drawing.check_picture` must have passed.

    Raises OSError if it cannot be written.
    """
    rig_picture(config).savefig(path, dpi=110)


def rig_picture(config: RigConfig) -> Any:
    """The figure of matplotlib: seen from above at the left, from the side at the right."""
    from matplotlib.figure import Figure as Picture

    places = places_of(config)
    along_x = _along_x(config)
    picture: Any = Picture(figsize=(13.0, 6.4), layout="constrained")
    above, side = picture.subplots(1, 2)
    _from_above(above, config, places)
    _from_the_side(side, config, places, along_x)
    handles, labels = above.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    picture.suptitle(f"{_plain(config.name)}: base frame, mm; reach from the nominal dimensions of the i5")
    return picture


def _along_x(config: RigConfig) -> bool:
    """Whether the sheet lies before the arm along base x rather than along y: the side view shows that direction."""
    x_mm, y_mm = to_base(config.paper, *(0.5 * v for v in config.paper.size_mm))
    return abs(x_mm) >= abs(y_mm)


def _from_above(axes: Axes, config: RigConfig, places: Sequence[Place]) -> None:
    from matplotlib.patches import Circle, Polygon, Rectangle

    limits, board = limits_of(config), config.board
    axes.plot(0.0, 0.0, "+", color="black", markersize=14, mew=2.0, label="base of the arm")
    if (ring := _ring(config, config.paper.touch_z_mm)) is not None:
        for radius, label in ((ring.least_mm, None), (ring.most_mm, "reach at the height of the sheet")):
            axes.add_patch(Circle(ring.centre_mm, radius, fill=False, edgecolor=GREY, linestyle=":", label=label))
    size = (limits.x_mm[1] - limits.x_mm[0], limits.y_mm[1] - limits.y_mm[0])
    corner = (limits.x_mm[0], limits.y_mm[0])
    axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=ORANGE, linewidth=1.6, label="box of limits"))
    board_mm = [n * board.square_mm for n in board.squares]
    outline = _rectangle(config, board.origin_mm, board_mm)
    axes.add_patch(Polygon(outline, fill=False, edgecolor=GREY, linestyle="--", label="board"))
    sheet = _rectangle(config, (0.0, 0.0), config.paper.size_mm)
    axes.add_patch(Polygon(sheet, facecolor=PAPER, edgecolor="black", label="sheet"))
    for tip, name in (((40.0, 0.0), "x"), ((0.0, 40.0), "y")):
        arrow = {"arrowstyle": "->", "color": "black"}
        axes.annotate("", to_base(config.paper, *tip), to_base(config.paper, 0.0, 0.0), arrowprops=arrow)
        axes.annotate(name, to_base(config.paper, *(1.25 * v for v in tip)), ha="center", va="center", fontsize=9)
    _marks(axes, places, (0, 1))
    points = [(0.0, 0.0), corner, (limits.x_mm[1], limits.y_mm[1]), *outline, *(p.at_mm[:2] for p in places)]
    _within(axes, [*points, *_farthest(config, (0, 1))])
    finish(axes, "from above", ("base x mm", "base y mm"))


def _from_the_side(axes: Axes, config: RigConfig, places: Sequence[Place], along_x: bool) -> None:
    from matplotlib.patches import Rectangle

    limits, paper = limits_of(config), config.paper
    axis, other = (0, 1) if along_x else (1, 0)
    across = (limits.x_mm, limits.y_mm)[axis]
    size = (across[1] - across[0], limits.z_mm[1] - limits.z_mm[0])
    axes.add_patch(Rectangle((across[0], limits.z_mm[0]), *size, fill=False, edgecolor=ORANGE, linewidth=1.6))
    axes.plot(0.0, 0.0, "+", color="black", markersize=14, mew=2.0)
    corners = [p.at_mm[axis] for p in places if p.kind == "sheet"]
    ends = (min(corners), max(corners))
    axes.plot(ends, (paper.touch_z_mm,) * 2, color="black", linewidth=3.0, solid_capstyle="butt")
    axes.annotate("sheet", (ends[1], paper.touch_z_mm), (4, -9), textcoords="offset points", fontsize=8)
    safe_z_mm = config.motion.safe_z_mm
    axes.plot(across, (safe_z_mm,) * 2, color=GREEN, linestyle="-.", linewidth=1.0)
    axes.annotate("travel", (across[1], safe_z_mm), (-4, 3), textcoords="offset points", fontsize=8, ha="right")
    for place in places:
        if place.kind not in ("sheet", "touch"):
            axes.plot((place.at_mm[axis],) * 2, (place.at_mm[2], place.top_mm), color=GREY, linewidth=0.8)
    _marks(axes, places, (axis, 2))
    points = [(0.0, 0.0), (across[0], limits.z_mm[0]), (across[1], limits.z_mm[1])]
    _within(axes, [*points, *_farthest(config, (axis, 2)), *((p.at_mm[axis], p.at_mm[2]) for p in places)])
    middle = to_base(paper, *(0.5 * v for v in paper.size_mm))
    _reach_line(axes, config, middle[other], forward=middle[axis] >= 0.0, axis=axis)
    name = "xy"[axis]
    finish(axes, f"from the side; reach at {'xy'[other]} = {middle[other]:.0f} mm", (f"base {name} mm", "base z mm"))


def _reach_line(axes: Axes, config: RigConfig, beside_mm: float, *, forward: bool, axis: int) -> None:
    """The farthest and the nearest point of the tip at each height, in the plane beside the middle of the sheet."""
    low, high = axes.get_ylim()
    heights = [low + (high - low) * number / HEIGHTS for number in range(HEIGHTS + 1)]
    rings = [(z_mm, ring) for z_mm in heights if (ring := _ring(config, z_mm)) is not None]
    for far in (False, True):
        line: list[tuple[float, float]] = []
        for z_mm, ring in rings:
            radius_mm = ring.most_mm if far else ring.least_mm
            aside_mm = beside_mm - ring.centre_mm[1 - axis]
            if radius_mm > abs(aside_mm):
                out_mm = math.sqrt(radius_mm**2 - aside_mm**2)
                line.append((ring.centre_mm[axis] + (out_mm if forward else -out_mm), z_mm))
        if line:
            axes.plot(*zip(*line, strict=True), color=GREY, linestyle=":")


def _farthest(config: RigConfig, axes: tuple[int, int]) -> list[tuple[float, float]]:
    """The end of the reach behind the middle of the sheet, along the axis of the base that leads there, if any."""
    ring = _ring(config, config.paper.touch_z_mm)
    if ring is None:
        return []
    middle = to_base(config.paper, *(0.5 * v for v in config.paper.size_mm))
    axis = 0 if _along_x(config) else 1
    end = [0.0, 0.0, config.paper.touch_z_mm]
    end[axis] = math.copysign(ring.most_mm, middle[axis])
    return [(end[axes[0]], end[axes[1]])]


def _ring(config: RigConfig, z_mm: float) -> Ring | None:
    return upright_ring(z_mm, config.paper.yaw_deg, tool_of(config.robot))


def _rectangle(
    config: RigConfig, corner_mm: tuple[float, float], size_mm: Sequence[float]
) -> list[tuple[float, float]]:
    """The corners of a rectangle of the paper frame, in the base frame."""
    (x, y), (width, height) = corner_mm, size_mm
    return [to_base(config.paper, *at) for at in ((x, y), (x + width, y), (x + width, y + height), (x, y + height))]


def _marks(axes: Axes, places: Sequence[Place], axis: tuple[int, int]) -> None:
    named: set[str] = set()
    for place in places:
        if place.kind in MARKS:
            marker, colour, label = MARKS[place.kind]
            at = [place.at_mm[i] for i in axis]
            shown = None if label in named else label
            axes.plot(*at, marker, color=colour, markersize=9, mew=2.0, linestyle="none", label=shown)
            named.add(label)


def _within(axes: Axes, points: Sequence[tuple[float, ...]]) -> None:
    for limit, along in zip((axes.set_xlim, axes.set_ylim), zip(*points, strict=True), strict=True):
        limit(min(along) - MARGIN_MM, max(along) + MARGIN_MM)


def _plain(name: str) -> str:
    """Escape what matplotlib would read as TeX."""
    return name.replace("$", r"\$")
