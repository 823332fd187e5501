"""The files of a plan: the protocol that draws it, its images as data, and a picture of wanted and simulated."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from calibrate.files import write_whole
from calibrate.writing.plan import Planned, Settings
from calibrate.writing.record import FILE as RECORD
from calibrate.writing.record import PlannedBy, PlanRecord, figure_record

PROTOCOL, PICTURE = "protocol-write.toml", "plan.png"
PAPER, WANTED, DRAWN = "#fbf9f4", "#2d72ff", "#d1341f"


def write_plan(figures: list[Planned], settings: Settings, by: PlannedBy, label: str, repeats: int, out: Path) -> Path:
    """Write picture, plan.json and protocol into a folder; returns the protocol's path. Raises OSError.

    `label` names the model that planned for people. The protocol is written last: where it is, the rest is.
    """
    out.mkdir(parents=True, exist_ok=True)
    draw(figures, settings, out / PICTURE)
    records = tuple(
        figure_record(
            one.wanted.name,
            one.wanted.source,
            one.strokes,
            one.strokes,
            wanted=one.wanted.image,
            simulated=one.simulated,
        )
        for one in figures
    )
    record = PlanRecord(
        model=label,
        planned_by=by,
        cell_mm=settings.cell.side_mm,
        software=f"brushloop {version('brushloop')}",
        figures=records,
    )
    return write_record(record, repeats, out)


def write_record(record: PlanRecord, repeats: int, out: Path) -> Path:
    """Write plan.json, then the protocol that draws it; returns the protocol's path. Raises OSError."""
    protocol = out / PROTOCOL
    write_whole(out / RECORD, record.model_dump_json(indent=2) + "\n")
    write_whole(protocol, write_toml(record, repeats))
    return protocol


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


def draw(figures: list[Planned], settings: Settings, path: Path) -> None:
    """A row a figure: wanted, first plan, refined plan, and the axis of the brush over the wanted strokes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    side = settings.cell.side_mm
    made = Figure((12.0, 3.4 * len(figures)), dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(made)
    rows = made.subplots(len(figures), 4, squeeze=False)
    extent = (0.0, side, 0.0, side)
    for figure, axes in zip(figures, rows, strict=True):
        first_csim, first_ssim, last_csim, last_ssim = figure.scores()
        # Code points, not the characters: most machines have no font of theirs for the picture.
        name = " ".join(f"U+{ord(c):04X}" if ord(c) > 0x2E7F else c for c in figure.wanted.name)
        titles = (
            f"wanted: {name}",
            f"first plan, simulated: CSIM {first_csim:.4f}, SSIM {first_ssim:.4f}",
            f"refined, simulated: CSIM {last_csim:.4f}, SSIM {last_ssim:.4f}",
            "points of the trajectory",
        )
        images = (figure.wanted.image, figure.first, figure.simulated, 0.25 * figure.wanted.image)
        for axis, image, title in zip(axes, images, titles, strict=True):
            axis.imshow(1 - image, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.tick_params(labelsize=7)
        for stroke in figure.strokes:
            axes[3].plot(stroke[:, 0], stroke[:, 1], "-", color=WANTED, lw=0.8)
            axes[3].scatter(stroke[:, 0], stroke[:, 1], s=2 * stroke[:, 2], color=DRAWN, zorder=3)
        axes[0].set_ylabel("mm", fontsize=7)
    untyped: Any = made
    untyped.savefig(path, format="png", metadata={"Software": None})
