"""Writes the report of strokes that travel: one HTML file that needs nothing else, and a CSV of what was measured."""

from __future__ import annotations

import io
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from calibrate.drags.measure import DragResults
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
