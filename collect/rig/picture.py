"""A picture of the rig in the base frame, from above: box, sheet, board, and every place. Plans use it too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import to_base
from brushloop.collect.rig.places import Kind, Place, places_of

Axes = Any
"""Axes of matplotlib, whose types are incomplete."""
ENDINGS = (".png", ".svg", ".pdf", ".jpg")
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
"""From the palette of Okabe and Ito, which colour-blind people can tell apart; the marks differ in shape too."""
PAPER = "#fbf7ea"
MARKS: dict[Kind, tuple[str, str, str]] = {
    "well": ("o", BLUE, "well"),
    "rim": ("v", BLUE, "wipe, over the rim"),
    "pot": ("s", BLUE, "wash pot"),
    "park": ("^", GREEN, "park"),
    "touch": ("x", ORANGE, "touch point"),
}
"""Marker, colour and name in the legend; the sheet is drawn as an area."""
MARGIN_MM = 60.0


def check_picture(path: Path) -> None:
    """Raise `ConfigError` if no picture can be written to this path. Called before anything is computed."""
    if path.suffix.lower() not in ENDINGS:
        raise ConfigError("--picture", "", f"{path} must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    if not path.parent.is_dir():
        raise ConfigError("--picture", "", f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ConfigError("--picture", "", f"{path} is a folder")


def draw_rig(config: RigConfig, path: Path) -> None:
    """Write the picture, in the format of the file's ending. `check_picture` must have passed.

    Raises OSError if it cannot be written.
    """
    rig_picture(config).savefig(path, dpi=110)


def rig_picture(config: RigConfig) -> Any:
    """The figure of matplotlib."""
    from matplotlib.figure import Figure as Picture

    picture: Any = Picture(figsize=(7.2, 6.4), layout="constrained")
    above = picture.subplots()
    from_above(above, config)
    handles, labels = above.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    picture.suptitle(f"{shown_name(config.name)}: base frame, mm")
    return picture


def from_above(axes: Axes, config: RigConfig) -> None:
    """Everything that stands on the table, and the box of limits."""
    from matplotlib.patches import Polygon, Rectangle

    limits, board, places = limits_of(config), config.board, places_of(config)
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


def finish(axes: Axes, title: str, along: tuple[str, str] = ("x mm", "y mm")) -> None:
    """Equal scales, a title, and labels that say what runs `along` the axes."""
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(along[0], fontsize=8)
    axes.set_ylabel(along[1], fontsize=8)
    axes.tick_params(labelsize=8)


def shown_name(name: str) -> str:
    """A name that every font can show: characters beyond Latin as code points, and nothing that is read as TeX."""
    return "".join(c if ord(c) < 0x250 else f"U+{ord(c):04X}" for c in name).replace("$", r"\$")
