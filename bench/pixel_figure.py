"""Draw the figure of docs/raster.md, the pixel and heading convention: `python -m bench.pixel_figure [PATH]`.

The gray squares are coverage from `model.raster`, the outline is `shape.outline()`: what the figure says is what
the code does.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.raster.exact import coverage_at
from brushloop.model.raster.frame import to_pixels

SIZE_PX, PX_MM = 16, 1.6
ORIGIN_MM = (17.0, 16.8)
HEADING_DEG = 25.0
INK, FRAME, STROKE = "0.35", "tab:blue", "tab:red"


def main() -> None:
    """Write the figure; the path is docs/raster-pixels.png unless given."""
    parser = argparse.ArgumentParser(prog="python -m bench.pixel_figure", description="Draw the pixel convention.")
    parser.add_argument("path", nargs="?", type=Path, default=Path("docs/raster-pixels.png"))
    figure = Figure(figsize=(7.2, 7.4), layout="constrained")
    with mpl.rc_context({"font.size": 10}):
        draw(figure.add_subplot())
        figure.savefig(parser.parse_args().path, dpi=110)


def draw(axes: Axes) -> None:
    """One mark on a coarse raster with everything named."""
    mark = ccdbsm(Brush(), 13.0, 5.0, 0.5 * math.pi)
    image = coverage_at(mark, ORIGIN_MM, HEADING_DEG, size_px=SIZE_PX, px_mm=PX_MM)[0].numpy()
    axes.imshow(1 - 0.35 * image, cmap="gray", vmin=0, vmax=1, extent=(0, SIZE_PX, SIZE_PX, 0))
    m = to_pixels(ORIGIN_MM, HEADING_DEG, PX_MM, mark.lam)[0].numpy()

    def pixels(points_mm: np.ndarray) -> np.ndarray:
        return np.stack((points_mm @ m[:2] + m[2], points_mm @ m[3:5] + m[5]), axis=-1)

    outline = pixels(mark.outline().polyline(64)[0].numpy())
    axes.plot(*np.vstack((outline, outline[:1])).T, color=INK, lw=1.5)
    ends = pixels(np.array([[0, 0], [7.2, 0], [0, 6.5], [float(mark.x_min_mm), 0], [float(mark.x_max_mm), 0]]))
    origin = ends[0]
    for end, name, shift in ((ends[1], "+x: belly, ferrule", (-3.2, -0.4)), (ends[2], "+y", (-0.7, -0.2))):
        axes.annotate("", end, origin, arrowprops={"arrowstyle": "-|>", "color": STROKE, "lw": 1.8})
        axes.text(end[0] + shift[0], end[1] + shift[1], name, color=STROKE)
    axes.plot(*origin, "o", color=STROKE)
    axes.text(origin[0] + 0.2, origin[1] + 0.9, "origin O3", color=STROKE)
    axes.text(ends[3][0] - 0.6, ends[3][1] + 0.9, "tip, x = -O4O3", color=STROKE)
    angle = np.radians(np.linspace(0, HEADING_DEG, 30))
    axes.plot(origin[0] + 3.6 * np.cos(angle), origin[1] - 3.6 * np.sin(angle), color=STROKE, lw=1)
    axes.plot([origin[0], origin[0] + 4.4], [origin[1]] * 2, color=STROKE, lw=0.8, ls=":")
    half = math.radians(HEADING_DEG / 2)
    axes.text(origin[0] + 3.75 * math.cos(half), origin[1] - 3.75 * math.sin(half) + 0.2, "heading", color=STROKE)
    _frame(axes, origin)


def _frame(axes: Axes, origin: np.ndarray) -> None:
    """The image's own side: edges, one pixel with its centre, and the two numbers of origin_mm."""
    arrow = {"arrowstyle": "<->", "color": FRAME, "lw": 1.3}
    axes.annotate("", (0, origin[1]), tuple(origin), arrowprops=arrow)
    axes.text(0.2, origin[1] - 0.2, "origin_mm[0], from the left edge", color=FRAME)
    axes.annotate("", (origin[0], 0), tuple(origin), arrowprops=arrow)
    axes.text(origin[0] + 0.15, 1.3, "origin_mm[1],\nfrom the top edge", color=FRAME, va="center")
    row, column = 2, 3
    axes.add_patch(Rectangle((column, row), 1, 1, fill=False, ec=FRAME, lw=2))
    axes.plot(column + 0.5, row + 0.5, "+", color=FRAME)
    axes.text(column - 2.7, row - 0.3, f"pixel ({row}, {column}), centre ({row + 0.5}, {column + 0.5})", color=FRAME)
    axes.set_xticks(range(SIZE_PX + 1))
    axes.set_yticks(range(SIZE_PX + 1))
    axes.grid(color="0.75", lw=0.5)
    axes.xaxis.tick_top()
    axes.xaxis.set_label_position("top")
    axes.set_xlabel("column edges, growing to the right")
    axes.set_ylabel("row edges, growing downwards")
    axes.set_xlim(0, SIZE_PX)
    axes.set_ylim(SIZE_PX, 0)


if __name__ == "__main__":
    main()
