"""The picture of a plan: wanted and predicted images, and the trajectory over the phases of the strokes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from brushloop.calibrate.report import picture_grid, save_picture
from brushloop.model.characters.phases import Phase, phases_of

if TYPE_CHECKING:
    from brushloop.calibrate.writing.plan import PlannedFigure, Settings

BLUE = "#2d72ff"
COLOURS = {
    Phase.INITIATION_HIDDEN: "#117733",
    Phase.INITIATION_EXPOSED: "#44aa99",
    Phase.EXECUTION: "#888888",
    Phase.TURNING: "#e69f00",
    Phase.FOLDING: "#d1341f",
    Phase.TERMINATION_HIDDEN: "#332288",
    Phase.TERMINATION_EXPOSED: "#cc79a7",
}


def draw(figures: list[PlannedFigure], settings: Settings, path: Path) -> None:
    """Draw a row per figure: wanted, first plan, refined plan, and the tip's trajectory over the strokes' phases."""
    side = settings.cell.side_mm
    picture, rows = picture_grid(len(figures), 4, (12.0, 3.4 * len(figures)))
    extent = (0.0, side, 0.0, side)
    for figure, axes in zip(figures, rows, strict=True):
        first_csim, first_ssim, last_csim, last_ssim = figure.scores()
        wanted = figure.request.image
        titles = (
            f"wanted: {code_points(figure.request.name)}",
            f"first plan, simulated: CSIM {first_csim:.4f}, SSIM {first_ssim:.4f}",
            f"refined, simulated: CSIM {last_csim:.4f}, SSIM {last_ssim:.4f}",
            "phases of the strokes; blue: trajectory",
        )
        images = (wanted, figure.first, figure.simulated, 0.25 * wanted)
        for axis, image, title in zip(axes, images, titles, strict=True):
            axis.imshow(1 - image, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.tick_params(labelsize=7)
        for stroke, way in zip(figure.strokes, figure.request.ways, strict=True):
            axes[3].plot(stroke[:, 0], stroke[:, 1], "-", color=BLUE, lw=0.8)
            colours = [COLOURS[phase] for phase in phases_of(way)]
            axes[3].scatter(way.points[:, 0], way.points[:, 1], s=22, color=colours, marker="s", zorder=2)
            axes[3].scatter(stroke[:, 0], stroke[:, 1], s=0.4 * stroke[:, 2], color=BLUE, zorder=3)
        axes[0].set_ylabel("mm", fontsize=7)
    for phase, colour in COLOURS.items():
        rows[0][3].scatter([], [], s=14, color=colour, marker="s", label=str(phase))
    rows[0][3].legend(fontsize=5, loc="lower right")
    save_picture(picture, path)


def code_points(name: str) -> str:
    """A name with code points for Chinese characters, since most machines have no font that shows them."""
    return " ".join(f"U+{ord(c):04X}" if ord(c) > 0x2E7F else c for c in name)
