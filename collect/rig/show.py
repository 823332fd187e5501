"""Where the tip goes, in the base frame: as a table, and as a picture from above, which plans use too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from brushloop.calibrate.board.spec import size_mm
from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import to_base, to_paper

Axes = Any
"""Axes of matplotlib, whose types are incomplete."""
ENDINGS = (".png", ".svg", ".pdf", ".jpg")
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
"""From the palette of Okabe and Ito, which colour-blind people can tell apart; the marks differ in shape too."""
PAPER = "#fbf7ea"
Kind = Literal["sheet", "touch", "well", "rim", "pot", "park"]
MARKS: dict[Kind, tuple[str, str, str]] = {
    "well": ("o", BLUE, "well"),
    "rim": ("v", BLUE, "wipe, over the rim"),
    "pot": ("s", BLUE, "wash pot"),
    "park": ("^", GREEN, "park"),
    "touch": ("x", ORANGE, "touch point"),
}
"""Marker, colour and name in the legend; the sheet is drawn as an area."""
MARGIN_MM = 60.0


@dataclass(frozen=True, slots=True)
class Place:
    """Where the tip of the upright brush goes."""

    kind: Kind
    name: str
    at_mm: tuple[float, float, float]
    """In the base frame; z is the lowest height of the tip there."""
    top_mm: float
    """Height in the base frame from which the tip comes down to it."""


def places_of(config: RigConfig) -> tuple[Place, ...]:
    """Every place of `rig.toml`, the corners of the sheet first."""
    paper, ink, motion = config.paper, config.ink, config.motion

    def over(kind: Kind, name: str, paper_mm: tuple[float, float], z_mm: float) -> Place:
        return Place(kind, name, (*to_base(paper, *paper_mm), z_mm), motion.safe_z_mm)

    deepest_mm = paper.touch_z_mm - config.brush.max_depth_mm
    width, height = paper.size_mm
    places = [
        over("sheet", "sheet lower left", (0.0, 0.0), deepest_mm),
        over("sheet", "sheet lower right", (width, 0.0), deepest_mm),
        over("sheet", "sheet upper right", (width, height), deepest_mm),
        over("sheet", "sheet upper left", (0.0, height), deepest_mm),
        over("well", "well", ink.well_mm, ink.dip_z_mm),
    ]
    if ink.wipe is not None:
        places.append(over("rim", "wipe, over the rim", ink.wipe.rim_mm, ink.wipe.z_mm))
    if ink.wash is not None:
        places.append(over("pot", "wash pot", ink.wash.pot_mm, ink.wash.dip_z_mm))
    places.append(Place("park", "park", motion.park_mm, max(motion.park_mm[2], motion.safe_z_mm)))
    for number, point_mm in enumerate(config.touch.points_mm or [paper.touch_point_mm], 1):
        places.append(over("touch", f"touch point {number}", point_mm, paper.touch_z_mm))
    return tuple(places)


def rig_table(config: RigConfig) -> Table:
    """A place a row, in the frames of the base and of the paper, in mm; then two corners of the box of limits."""
    limits = limits_of(config)
    table = Table("place", "base x", "y", "z", "paper x", "y", title=f"{config.name}: mm")
    for column in table.columns[1:]:
        column.justify = "right"
    for place in places_of(config):
        paper_mm = to_paper(config.paper, *place.at_mm[:2])
        table.add_row(place.name, *(f"{v:.1f}" for v in (*place.at_mm, *paper_mm)))
    for end, *corner in zip(("lowest", "highest"), limits.x_mm, limits.y_mm, limits.z_mm, strict=True):
        table.add_row(f"box, {end}", *(f"{v:.1f}" for v in corner))
    return table


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
    from matplotlib.figure import Figure as Picture

    picture: Any = Picture(figsize=(7.2, 6.4), layout="constrained")
    above = picture.subplots()
    from_above(above, config)
    handles, labels = above.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    picture.suptitle(f"{shown_name(config.name)}: base frame, mm")
    picture.savefig(path, dpi=110)


def from_above(axes: Axes, config: RigConfig) -> None:
    """Everything that stands on the table, and the box of limits."""
    from matplotlib.patches import Polygon, Rectangle

    limits, paper, places = limits_of(config), config.paper, places_of(config)
    axes.plot(0.0, 0.0, "+", color="black", markersize=14, mew=2.0, label="base of the arm")
    (left, right), (low, high) = limits.x_mm, limits.y_mm
    box = Rectangle((left, low), right - left, high - low, fill=False, edgecolor=ORANGE, linewidth=1.6)
    box.set_label("box of limits")
    axes.add_patch(box)
    board = _rectangle(config, config.board.origin_mm, size_mm(config.board))
    axes.add_patch(Polygon(board, fill=False, edgecolor=GREY, linestyle="--", label="board"))
    sheet = _rectangle(config, (0.0, 0.0), paper.size_mm)
    axes.add_patch(Polygon(sheet, facecolor=PAPER, edgecolor="black", label="sheet"))
    for name, tip in (("x", (40.0, 0.0)), ("y", (0.0, 40.0))):
        axes.annotate("", to_base(paper, *tip), paper.origin_mm, arrowprops={"arrowstyle": "->", "color": "black"})
        axes.annotate(name, to_base(paper, *(1.25 * v for v in tip)), ha="center", va="center", fontsize=9)
    named: set[str] = set()
    for place in places:
        if place.kind in MARKS:
            marker, colour, label = MARKS[place.kind]
            shown = None if label in named else label
            axes.plot(*place.at_mm[:2], marker, color=colour, markersize=9, mew=2.0, linestyle="none", label=shown)
            named.add(label)
    ends = [(0.0, 0.0), (left, low), (right, high), *board, *(place.at_mm[:2] for place in places)]
    for limit, along in zip((axes.set_xlim, axes.set_ylim), zip(*ends, strict=True), strict=True):
        limit(min(along) - MARGIN_MM, max(along) + MARGIN_MM)
    finish(axes, "from above", ("base x mm", "base y mm"))


def _rectangle(
    config: RigConfig, corner_mm: tuple[float, float], size_mm: Sequence[float]
) -> list[tuple[float, float]]:
    """The corners of a rectangle of the paper frame, in the base frame."""
    (x, y), (width, height) = corner_mm, size_mm
    return [to_base(config.paper, *at) for at in ((x, y), (x + width, y), (x + width, y + height), (x, y + height))]


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
