"""The files of a plan: plan.json with images for a later comparison with ink, the protocol, and a picture."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from brushloop.calibrate.compare.field import Image
from brushloop.calibrate.report import write_files
from brushloop.calibrate.writing.picture import draw
from brushloop.calibrate.writing.plan_record import FILE, PROTOCOL, FigureRecord, Floats, PlannedBy, PlanRecord, Points
from brushloop.model.characters.plan import Path as Way
from brushloop.sessions.messages import encode_png

if TYPE_CHECKING:
    from brushloop.calibrate.writing.plan import PlannedFigure, Settings

PICTURE = "plan.png"


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
