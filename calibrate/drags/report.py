"""The report of strokes that travel: one self-contained HTML file, a CSV of the measurements, a terminal summary."""

from __future__ import annotations

import io
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from rich.table import Table

from calibrate.drags.measure import DEPTH_NAMES, LENGTH_NAME, DragResults
from calibrate.files import write_whole
from calibrate.report import pictures
from calibrate.report.pages import render
from calibrate.report.wording import DRAG_LIMITS, fit_sentences, source_note
from sessions.cells import CsvWriter
from sessions.recording.schemas import Header

MAX_THUMBNAILS = 60


@dataclass(frozen=True, slots=True)
class DragValidation:
    """A recording of strokes that travel, and what was measured in it."""

    header: Header
    recording: Path
    recording_sha256: str
    results: DragResults


def write_drags(validation: DragValidation, folder: Path, command: str) -> Path:
    """Write `report.html` and `measured.csv` into `folder`; returns the report's path. Raises OSError."""
    results = validation.results
    step = max(1, -(-len(results.strokes) // MAX_THUMBNAILS))
    page = render(
        "drags.html.j2",
        header=validation.header,
        note=source_note(validation.header.source),
        refused=results.refused,
        provenance=_provenance(validation, command),
        strokes=len(results.strokes),
        limits=DRAG_LIMITS,
        sentences=list(fit_sentences(results)),
        plot=pictures.drag_plot(results) if results.strokes else "",
        drags=results.strokes,
        names=sorted({name for drag in results.strokes for name in drag.commanded}),
        thumbnails=[(d.stroke_id, pictures.data_uri(d.thumbnail)) for d in results.strokes[::step]],
        cut=[d.stroke_id for d in results.strokes if d.cut],
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "measured.csv", drags_csv(results, validation.header.source))
    report = folder / "report.html"
    write_whole(report, page)
    return report


def drags_csv(results: DragResults, source: str) -> str:
    """Commanded beside measured, one row a stroke."""
    names = sorted({name for drag in results.strokes for name in drag.commanded})
    out = io.StringIO()
    writer = CsvWriter(out)
    columns = ["measured_length_mm", "measured_width_mm", "measured_mid_width_mm", "measured_area_mm2", "cut", "source"]
    writer.writerow(["stroke_id", *(f"commanded_{name}" for name in names), *columns])
    for drag in results.strokes:
        m = drag.measured
        sizes = [f"{v:.3f}" for v in (m.length_mm, m.width_mm, m.mid_width_mm, m.area_mm2)]
        writer.writerow(
            [drag.stroke_id, *(drag.commanded.get(name, "") for name in names), *sizes, int(drag.cut), source]
        )
    return out.getvalue()


def _provenance(validation: DragValidation, command: str) -> list[tuple[str, str]]:
    header = validation.header
    rows = [
        ("source", str(header.source)),
        ("session", header.session_id),
        ("recording", f"{validation.recording.name}, sha256 {validation.recording_sha256}"),
        ("recorded with", header.software),
        ("brush", header.brush or "not known"),
        ("ink, paper", ", ".join(part for part in (header.ink, header.paper) if part)),
        ("protocol", header.protocol),
        ("origin", header.origin),
        ("licence", header.licence),
        ("validated with", f"brushloop {version('brushloop')}, Python {platform.python_version()}"),
        ("command", command),
    ]
    return [(name, text) for name, text in rows if text]


def summary(validation: DragValidation) -> Iterator[Table | str]:
    """Renderables for the terminal."""
    results = validation.results
    yield f"{validation.header.session_id}: {source_note(validation.header.source)}"
    yield _drags(results)
    yield from fit_sentences(results)
    for stroke_id, why in results.refused:
        yield f"not used: {stroke_id}: {why}"


def _drags(results: DragResults) -> Table:
    names = sorted({name for drag in results.strokes for name in drag.commanded})
    # The rest of what was commanded is in the CSV and the report: a terminal is 80 columns wide.
    shown = [n for n in (LENGTH_NAME, *DEPTH_NAMES, "tilt_deg") if n in names]
    columns = [*(f"commanded {n}" for n in shown), "length mm", "width mm", "at middle", "area mm²", "whole"]
    out = Table("stroke", *columns, title="commanded beside measured")
    out.columns[0].overflow = "fold"
    for drag in results.strokes:
        m = drag.measured
        sizes = (f"{m.length_mm:.2f}", f"{m.width_mm:.2f}", f"{m.mid_width_mm:.2f}", f"{m.area_mm2:.1f}")
        values = (f"{drag.commanded[n]:.2f}" if n in drag.commanded else "" for n in shown)
        out.add_row(drag.stroke_id, *values, *sizes, "no" if drag.cut else "yes")
    return out
