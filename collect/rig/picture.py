"""A picture of the rig in the base frame, from above: box, sheet, board, and every place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.drawing import BLUE, GREEN, GREY, ORANGE, PAPER, Axes, finish
from brushloop.collect.rig.paper import to_base
from brushloop.collect.rig.places import Kind, Place, places_of

MARKS: dict[Kind, tuple[str, str, str]] = {
    "well": ("o", BLUE, "well"),
    "rim": ("v", BLUE, "wipe, over the rim"),
    "pot": ("s", BLUE, "wash pot"),
    "park": ("^", GREEN, "park"),
    "touch": ("x", ORANGE, "touch point"),
}
"""Marker, colour and name in the legend; the sheet is drawn as an area."""
MARGIN_MM = 60.0


def draw_rig(config: RigConfig, path: Path) -> None:
    """Write the picture, in the format of the file's ending. `collect.rig.drawing.check_picture` must have passed.

    Raises OSError if it cannot be written.
    """
    rig_picture(config).savefig(path, dpi=110)


def rig_picture(config: RigConfig) -> Any:
    """The figure of matplotlib."""
    from matplotlib.figure import Figure as Picture

    places = places_of(config)
    picture: Any = Picture(figsize=(7.2, 6.4), layout="constrained")
    above = picture.subplots()
    _from_above(above, config, places)
    handles, labels = above.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    picture.suptitle(f"{_plain(config.name)}: base frame, mm")
    return picture


def _from_above(axes: Axes, config: RigConfig, places: Sequence[Place]) -> None:
    from matplotlib.patches import Polygon, Rectangle

    limits, board = limits_of(config), config.board
    axes.plot(0.0, 0.0, "+", color="black", markersize=14, mew=2.0, label="base of the arm")
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
    _marks(axes, places)
    _within(axes, [(0.0, 0.0), corner, (limits.x_mm[1], limits.y_mm[1]), *outline, *(p.at_mm[:2] for p in places)])
    finish(axes, "from above", ("base x mm", "base y mm"))


def _rectangle(
    config: RigConfig, corner_mm: tuple[float, float], size_mm: Sequence[float]
) -> list[tuple[float, float]]:
    """The corners of a rectangle of the paper frame, in the base frame."""
    (x, y), (width, height) = corner_mm, size_mm
    return [to_base(config.paper, *at) for at in ((x, y), (x + width, y), (x + width, y + height), (x, y + height))]


def _marks(axes: Axes, places: Sequence[Place]) -> None:
    named: set[str] = set()
    for place in places:
        if place.kind in MARKS:
            marker, colour, label = MARKS[place.kind]
            shown = None if label in named else label
            axes.plot(*place.at_mm[:2], marker, color=colour, markersize=9, mew=2.0, linestyle="none", label=shown)
            named.add(label)


def _within(axes: Axes, points: Sequence[tuple[float, ...]]) -> None:
    for limit, along in zip((axes.set_xlim, axes.set_ylim), zip(*points, strict=True), strict=True):
        limit(min(along) - MARGIN_MM, max(along) + MARGIN_MM)


def _plain(name: str) -> str:
    """Escape what matplotlib would read as TeX."""
    return name.replace("$", r"\$")
