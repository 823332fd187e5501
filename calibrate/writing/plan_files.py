"""The files of a plan: plan.json with images for a later comparison with ink, the protocol, and a picture."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from brushloop.calibrate.compare.place import Image
from brushloop.calibrate.report import picture_grid, save_picture, write_files
from brushloop.calibrate.writing.plan_record import FILE, PROTOCOL, FigureRecord, Floats, PlannedBy, PlanRecord, Points
from brushloop.model.characters.phases import Phase, phases_of
from brushloop.model.characters.plan import Path as Way
from brushloop.sessions.messages import encode_png

if TYPE_CHECKING:
    from brushloop.calibrate.writing.plan import PlannedFigure, Settings
if TYPE_CHECKING:
    from brushloop.calibrate.writing.plan import PlannedFigure, Settings

PICTURE = "plan.png"
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


def figure_record(
    name: str,
    source: str,
    commanded: Sequence[Floats],
    intended: Sequence[Floats],
    *,
    wanted: Image,
    simulated: Image,
    ways: Sequence[Way] = (),
) -> FigureRecord:
    """Record of a planned figure: trajectories (N, 5), images (128, 128), medians with half widths."""
    return FigureRecord(
        name=name,
        source=source,
        commanded=as_points(commanded),
        intended=as_points(intended),
        wanted_png=encoded(wanted),
        simulated_png=encoded(simulated),
        medians=tuple(
            tuple(
                (round(x, 4), round(y, 4), round(half, 4))
                for (x, y), half in zip(way.points, way.half_width_mm, strict=True)
            )
            for way in ways
        ),
    )


def ways_of(figure: FigureRecord) -> list[Way]:
    """The medians of a figure as paths."""
    arrays = (np.array(one, np.float64) for one in figure.medians)
    return [Way(one[:, :2], one[:, 2]) for one in arrays]


def record_of(planned: PlannedFigure) -> FigureRecord:
    """Record of a figure as it was planned."""
    wanted = planned.request
    strokes, ways = planned.strokes, wanted.ways
    return figure_record(
        wanted.name, wanted.source, strokes, strokes, wanted=wanted.image, simulated=planned.simulated, ways=ways
    )


def write_plan(
    figures: list[PlannedFigure], settings: Settings, by: PlannedBy, label: str, repeats: int, out: Path
) -> Path:
    """Write picture, plan.json and protocol into a folder; returns the protocol's path. Raises OSError.

    `label` is the planning model's display name. The protocol is written last: if it exists, so do the others.
    """
    out.mkdir(parents=True, exist_ok=True)
    draw(figures, settings, out / PICTURE)
    record = PlanRecord(
        model=label,
        planned_by=by,
        cell_mm=settings.cell.side_mm,
        software=f"brushloop {version('brushloop')}",
        figures=tuple(record_of(one) for one in figures),
    )
    return write_record(record, repeats, out)


def write_record(record: PlanRecord, repeats: int, out: Path) -> Path:
    """Write plan.json, then the protocol that draws it; returns the protocol's path. Raises OSError."""
    write_files(out, {FILE: record.model_dump_json(indent=2) + "\n", PROTOCOL: write_toml(record, repeats)})
    return out / PROTOCOL


def write_toml(record: PlanRecord, repeats: int) -> str:
    """The `write` protocol."""
    side = record.cell_mm
    lines = [
        'kind = "write"',
        f"cell_mm = [{side!r}, {side!r}]",
        f"speed_mm_s = {record.planned_by.speed_mm_s!r}",
        "blend_mm = 1.0",
        f"repeats = {repeats}",
    ]
    for figure in record.figures:
        source = " ".join(figure.source.split())
        lines += ["", f"# From {json.dumps(source)}", "[[figures]]"]
        lines.append(f"name = {json.dumps(figure.name, ensure_ascii=False)}")
        for stroke in figure.commanded:
            lines += ["", "[[figures.strokes]]", "points = ["]
            lines += ["    [" + ", ".join(f"{value:.3f}" for value in point) + "]," for point in stroke]
            lines.append("]")
    return "\n".join(lines) + "\n"


def as_points(strokes: Sequence[Floats]) -> Points:
    """Convert trajectories (N, 5) to points, rounded like the protocol to 0.001."""
    rounded = (np.round(stroke, 3).tolist() for stroke in strokes)
    return tuple(tuple((x, y, height, tilt, heading) for x, y, height, tilt, heading in stroke) for stroke in rounded)


def encoded(ink: Image) -> str:
    """(128, 128) ink as a PNG in base64."""
    return base64.b64encode(encode_png(np.rint(255.0 * (1.0 - ink)).astype(np.uint8))).decode()


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
