"""Writes the report: one HTML file that needs nothing else, and a CSV of every number behind it."""

from __future__ import annotations

import platform
from importlib.resources import files
from pathlib import Path
from typing import Any

from calibrate import pictures
from calibrate.drags import DragResults
from calibrate.field import Alignment, Tone
from calibrate.files import write_whole
from calibrate.presses import CEILING, PressResults
from calibrate.similarity import SSIM_SETTINGS
from calibrate.tables import table
from calibrate.validation import Validation, drags_csv, scores_csv
from calibrate.wording import DRAG_LIMITS, fit_sentences, source_note

SHEET_MODEL = "ccd-bsm"
SHEET_ROWS = slice(32, 96)
MAX_THUMBNAILS = 60


def write_report(validation: Validation, folder: Path, command: str) -> Path:
    """Write `report.html` and its CSV into `folder`; returns the report's path. Raises OSError."""
    from jinja2 import Environment, StrictUndefined

    # Names, licences and origins come from files of others: everything is escaped.
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((files("calibrate") / "templates" / "report.html.j2").read_text("utf-8"))
    results = validation.results
    body = _presses(validation, results) if isinstance(results, PressResults) else _drags(results)
    page = template.render(
        header=validation.header,
        note=source_note(validation.header.source),
        refused=results.refused,
        provenance=_provenance(validation, command),
        **body,
    )
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(results, PressResults):
        write_whole(folder / "scores.csv", scores_csv(results.scores, validation.header.source))
    else:
        write_whole(folder / "measured.csv", drags_csv(results, validation.header.source))
    report = folder / "report.html"
    write_whole(report, page)
    return report


def _presses(validation: Validation, results: PressResults) -> dict[str, Any]:
    tables = [
        {
            "alignment": a,
            "tone": t,
            "rows": table(results.scores, a, t),
            "paper": (a, t) == (Alignment.SIZE_NORMALISED, Tone.BINARY),
        }
        for t in (Tone.BINARY, Tone.GRAY)
        for a in (Alignment.SIZE_NORMALISED, Alignment.MM)
    ]
    return {
        "kind": "press",
        "strokes": len(results.strokes),
        "tables": tables,
        "ceiling": CEILING,
        "has_ceiling": any(score.model == CEILING for score in results.scores),
        "models": list(validation.models.values()),
        "field": validation.field,
        "ssim_settings": SSIM_SETTINGS,
        "sheet": _contact_sheet(results),
        "plot": pictures.score_plot(results, validation.header.source) if results.scores else "",
        "cut": [s.stroke_id for s in results.strokes if s.cut],
    }


def _contact_sheet(results: PressResults) -> list[dict[str, Any]]:
    """The first capture of each cell: captured, predicted, difference, on the millimetre field."""
    key = (Alignment.MM, Tone.GRAY)
    rows: list[dict[str, Any]] = []
    seen: set[tuple[float, float]] = set()
    for stroke in sorted(results.strokes, key=lambda s: (s.height_mm, s.tilt_deg, s.stroke_id)):
        cell = (stroke.height_mm, stroke.tilt_deg)
        predicted = results.predicted.get((SHEET_MODEL, *cell))
        if cell in seen or predicted is None:
            continue
        seen.add(cell)
        # The middle half: a press is at most half as thick as the field is high.
        captured, predicted = stroke.images[key][SHEET_ROWS], predicted[SHEET_ROWS]
        rows.append(
            {
                "stroke": stroke,
                "captured": pictures.ink(captured),
                "predicted": pictures.ink(predicted),
                "difference": pictures.difference(captured, predicted),
            }
        )
    return rows


def _drags(results: DragResults) -> dict[str, Any]:
    step = max(1, -(-len(results.strokes) // MAX_THUMBNAILS))
    return {
        "kind": "drag",
        "strokes": len(results.strokes),
        "limits": DRAG_LIMITS,
        "sentences": list(fit_sentences(results)),
        "plot": pictures.drag_plot(results) if results.strokes else "",
        "drags": results.strokes,
        "names": sorted({name for drag in results.strokes for name in drag.commanded}),
        "thumbnails": [(d.stroke_id, pictures.data_uri(d.thumbnail)) for d in results.strokes[::step]],
        "cut": [d.stroke_id for d in results.strokes if d.cut],
    }


def _provenance(validation: Validation, command: str) -> list[tuple[str, str]]:
    header, calibration = validation.header, validation.calibration
    rows = [
        ("source", str(header.source)),
        ("session", header.session_id),
        ("recording", f"{validation.recording.name}, sha256 {validation.recording_sha256}"),
        ("recorded with", header.software),
        ("robot", f"{header.robot} {header.robot_firmware}".strip()),
        ("camera", f"{header.camera} {header.lens}".strip()),
        ("brush", _brush(validation)),
        ("ink, paper", ", ".join(part for part in (header.ink, header.paper) if part)),
        ("protocol", header.protocol),
        ("origin", header.origin),
        ("licence", header.licence),
        ("validated with", f"{validation.software}, Python {platform.python_version()}"),
        ("command", command),
    ]
    if calibration is not None:
        pix2len = (
            f"pix2len {calibration.mm_per_px:.5f} mm/px "
            f"(95 % {calibration.mm_per_px_low:.5f} to {calibration.mm_per_px_high:.5f}), "
            f"residual {calibration.rms_px:.3f} px over {calibration.corners} corners"
        )
        rows.insert(3, ("calibration", f"{calibration.digest}: {pix2len}"))
    return [(name, text) for name, text in rows if text]


def _brush(validation: Validation) -> str:
    header = validation.header
    if header.brush_radius_mm is None or header.brush_length_mm is None:
        return header.brush or "not known"
    return f"{header.brush}, R = {header.brush_radius_mm:g} mm, L = {header.brush_length_mm:g} mm"
