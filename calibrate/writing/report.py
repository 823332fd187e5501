"""Writes what came of written characters: Figure 13, one HTML file that needs nothing else, CSV and JSON."""

from __future__ import annotations

import base64
import hashlib
import io
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from calibrate.compare.field import Alignment, Tone
from calibrate.compare.similarity import SSIM_SETTINGS
from calibrate.files import write_whole
from calibrate.report.pages import render
from calibrate.report.pictures import difference, ink
from calibrate.report.wording import source_note
from calibrate.writing.compare import Written
from calibrate.writing.images import Polarity
from calibrate.writing.picture import draw, ranked
from calibrate.writing.scores import PAIRS, WrittenScore
from calibrate.writing.table import FILE as NUMBERS
from calibrate.writing.table import PICTURE, Table3Row, WrittenRecord
from sessions.cells import CsvWriter

PAGE, TABLE = "written.html", "written.csv"


def write_written(written: Written, folder: Path, command: str) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(written, folder / PICTURE)
    picture = (folder / PICTURE).read_bytes()
    page = render(
        "written.html.j2",
        header=written.header,
        note=source_note(written.header.source),
        names=" ".join(one.name for one in written.characters),
        writings=sum(len(one.captured) for one in written.characters),
        model=written.plan.model,
        cell_mm=written.plan.cell_mm,
        tables=_tables(written.table),
        characters=list(_characters(written)),
        refused=written.refused,
        cut=[stroke_id for one in written.characters for stroke_id in one.cut],
        ssim_settings=SSIM_SETTINGS,
        picture="data:image/png;base64," + base64.b64encode(picture).decode(),
        provenance=list(_provenance(written, command)),
    )
    write_whole(folder / TABLE, written_csv(written.scores, str(written.header.source)))
    write_whole(folder / NUMBERS, record_of(written, command, picture).to_json())
    write_whole(folder / PAGE, page)
    return folder / PAGE


def summary(written: Written) -> Iterator[str]:
    """Lines for the terminal: the strict and the lenient comparison, ink = 1."""
    count = sum(len(one.captured) for one in written.characters)
    yield f"{count} characters written, {len(written.refused)} not compared ({written.header.source})"
    for row in written.table:
        if row.polarity is Polarity.INK and row.tone is Tone.BINARY:
            csim, ssim = (" / ".join(f"{value:.2f}" for value in three) for three in (row.csim, row.ssim))
            yield f"{row.character} {row.alignment}, {row.pair}: CSIM {csim}, SSIM {ssim}"


def written_csv(scores: list[WrittenScore], source: str) -> str:
    """A row a comparison."""
    out = io.StringIO()
    writer = CsvWriter(out)
    writer.writerow(["character", "stroke_id", "pair", "alignment", "tone", "polarity", "csim", "ssim", "source"])
    for s in scores:
        numbers = (f"{s.csim:.6f}", f"{s.ssim:.6f}", source)
        writer.writerow([s.character, s.stroke_id, s.pair, s.alignment, s.tone, s.polarity, *numbers])
    return out.getvalue()


def record_of(written: Written, command: str, picture: bytes) -> WrittenRecord:
    """Everything but the images and the single scores, with its digest and that of Figure 13."""
    return WrittenRecord(
        source=written.header.source,
        session=written.header.session_id,
        recording_sha256=written.recording_sha256,
        brush=written.header.brush,
        model=written.plan.model,
        cell_mm=written.plan.cell_mm,
        table_3=tuple(written.table),
        refused=tuple(written.refused),
        figure_13_sha256=hashlib.sha256(picture).hexdigest(),
        software=written.software,
        command=command,
    ).sealed()


def _tables(table: list[Table3Row]) -> list[dict[str, Any]]:
    """A table an alignment and tone, both polarities in it."""
    out: list[dict[str, Any]] = []
    for tone in (Tone.BINARY, Tone.GRAY):
        for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM):
            rows = [row for row in table if (row.alignment, row.tone) == (alignment, tone)]
            rows.sort(key=lambda row: (PAIRS.index(row.pair), row.polarity is Polarity.PAPER))
            out.append({"alignment": alignment, "tone": tone, "rows": rows})
    return out


def _characters(written: Written) -> Iterator[dict[str, Any]]:
    for one in written.characters:
        reference = one.reference[Tone.GRAY]
        yield {
            "name": one.name,
            "reference_name": one.reference_name,
            "reference": ink(reference),
            "simulated": ink(one.simulated[Tone.GRAY]),
            "mean": difference(one.mean_ink(), reference),
            "captured": [(stroke_id, ink(one.captured[stroke_id][Tone.GRAY])) for stroke_id in ranked(written, one)],
        }


def _provenance(written: Written, command: str) -> Iterator[tuple[str, str]]:
    header, calibration = written.header, written.calibration
    yield "source", str(header.source)
    yield "recording", f"{written.recording.name}, sha256 {written.recording_sha256}"
    yield "calibration", f"{calibration.named}, pix2len {calibration.mm_per_px:.5f} mm/px"
    for one in written.characters:
        yield f"reference of {one.name}", one.reference_name
    yield "planned and simulated by", written.plan.model
    yield "robot", f"{header.robot} {header.robot_firmware}".strip()
    yield "camera", f"{header.camera} {header.lens}".strip()
    yield "brush, ink, paper", ", ".join(part for part in (header.brush, header.ink, header.paper) if part)
    yield "compared with", f"{written.software}, Python {platform.python_version()}"
    yield "command", command
