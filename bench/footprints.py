"""The simulated brush's footprints with CCD-BSM's outlines over them: `python -m bench.footprints [FILE]`.

Writes the picture of docs/loopback-brush.md. The two share nothing: the ink comes from `drivers.sim.brush`, the outline
from `model.ccdbsm`, and neither was fitted to the other.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import torch

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.paper import Footprint
from brushloop.model.brush import Brush as ModelBrush
from brushloop.model.ccdbsm import ccdbsm

OUT = Path(__file__).resolve().parent.parent / "docs" / "loopback-brush.png"
HEIGHTS_MM = tuple(range(11, 21))
TILTS_DEG = (0.0, 5.0, 10.0)
LABEL = "loopback rig: simulated, not paper"

LEFT_MM, RIGHT_MM, ROW_MM = 31.0, 9.0, 17.5
"""A cell reaches so far to either side of the zero-touch point; marks lie mostly toward -x, where the tip points."""
HEAD_MM, FOOT_MM, SIDE_MM = 19.0, 12.0, 11.0
MM_PER_INCH, DPI = 20.0, 140
"""Of the picture: 7 pixels a millimetre."""
POINTS = 200
PAPER, INK, MODEL, FAINT = "#fbf9f4", "#1a1a1a", "#d1341f", "#8a857b"


def draw(path: Path) -> None:
    """Draw all cells on one scale and write them as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    cell_mm = LEFT_MM + RIGHT_MM
    size_x_mm = SIDE_MM + cell_mm * len(TILTS_DEG) + 2.0
    size_y_mm = HEAD_MM + ROW_MM * len(HEIGHTS_MM) + FOOT_MM
    figure = Figure((size_x_mm / MM_PER_INCH, size_y_mm / MM_PER_INCH), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, size_x_mm), ylim=(size_y_mm, 0.0), aspect="equal")
    axes.axis("off")
    ink = LinearSegmentedColormap.from_list("ink", [PAPER, INK])
    brush = Brush(BrushSpec())
    for row, height in enumerate(HEIGHTS_MM):
        y_mm = HEAD_MM + ROW_MM * (row + 0.5)
        axes.text(SIDE_MM - 1.5, y_mm, f"{height}", ha="right", va="center", fontsize=9, color=INK)
        for column, tilt_deg in enumerate(TILTS_DEG):
            x_mm = SIDE_MM + cell_mm * column + LEFT_MM
            seed = row * len(TILTS_DEG) + column
            _footprint(axes, brush.press(height, tilt_deg, ink_load=1.0, press_seed=seed), x_mm, y_mm, ink)
            for side in (-1.0, 1.0):
                _outline(axes, float(height), tilt_deg, x_mm, y_mm, side)
            axes.plot([x_mm], [y_mm], marker="+", color=MODEL, markersize=5, markeredgewidth=0.7)
    _words(axes, size_x_mm, size_y_mm, cell_mm)
    figure.savefig(path, dpi=DPI, metadata={"Software": None})


def _footprint(axes: Any, mark: Footprint, x_mm: float, y_mm: float, ink: Any) -> None:
    """The ink with its zero-touch point at (x, y)."""
    rows, columns = mark.density.shape
    left, top = x_mm - mark.origin_px[0] / mark.px_per_mm, y_mm - mark.origin_px[1] / mark.px_per_mm
    extent = (left, left + columns / mark.px_per_mm, top + rows / mark.px_per_mm, top)
    axes.imshow(mark.density, cmap=ink, vmin=0.0, vmax=1.0, extent=extent, interpolation="antialiased")


def _outline(axes: Any, depth_mm: float, tilt_deg: float, x_mm: float, y_mm: float, side: float) -> None:
    """One side of CCD-BSM's mark; its origin lies H tan(alpha) from the zero-touch point, as in `validate`."""
    mark = ccdbsm(ModelBrush(), depth_mm, tilt_deg)
    # Points crowd at both ends, where the outline turns fastest.
    share = 0.5 - 0.5 * torch.cos(torch.linspace(0.0, math.pi, POINTS, dtype=torch.float64))
    along = mark.x_min_mm[:, None] + share * mark.length_mm[:, None]
    across = side * mark.half_width(along)[0]
    shift_mm = x_mm + depth_mm * math.tan(math.radians(tilt_deg))
    axes.plot((along[0] + shift_mm).tolist(), (across + y_mm).tolist(), color=MODEL, linewidth=1.1)


def _words(axes: Any, size_x_mm: float, size_y_mm: float, cell_mm: float) -> None:
    """Label, headings, legend and scale."""
    axes.text(SIDE_MM, 5.0, LABEL, fontsize=13, fontweight="bold", va="center", color=INK)
    axes.text(
        SIDE_MM, 10.0, "Ink of the simulated brush, and the outline that CCD-BSM gives for the same press",
        fontsize=8.5, va="center", color=INK,
    )  # fmt: skip
    for column, tilt_deg in enumerate(TILTS_DEG):
        x_mm = SIDE_MM + cell_mm * (column + 0.5)
        axes.text(x_mm, HEAD_MM - 3.0, f"α = {tilt_deg:g}°", ha="center", va="center", fontsize=10, color=INK)
    axes.text(SIDE_MM - 1.5, HEAD_MM - 3.0, "H mm", ha="right", va="center", fontsize=8, color=FAINT)
    for row in range(len(HEIGHTS_MM) + 1):
        y_mm = HEAD_MM + ROW_MM * row
        axes.plot([SIDE_MM, size_x_mm - 2.0], [y_mm, y_mm], color=FAINT, linewidth=0.3, alpha=0.5)
    foot_mm = size_y_mm - FOOT_MM / 2
    axes.plot([SIDE_MM, SIDE_MM + 10.0], [foot_mm, foot_mm], color=INK, linewidth=2.0, solid_capstyle="butt")
    axes.text(SIDE_MM + 11.5, foot_mm, "10 mm", va="center", fontsize=8, color=INK)
    axes.plot([SIDE_MM + 30.0, SIDE_MM + 36.0], [foot_mm, foot_mm], color=MODEL, linewidth=1.1)
    axes.text(SIDE_MM + 37.5, foot_mm, "CCD-BSM, R = 6, L = 48 mm, λ = π", va="center", fontsize=8, color=INK)
    axes.plot([SIDE_MM + 88.0], [foot_mm], marker="+", color=MODEL, markersize=5, markeredgewidth=0.7)
    axes.text(SIDE_MM + 90.0, foot_mm, "where the tip touched", va="center", fontsize=8, color=INK)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else OUT)
