"""Writes the loop: a picture, one HTML file that needs nothing else, and every number behind it as CSV and JSON."""

from __future__ import annotations

import base64
import io
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from calibrate.compare.field import Alignment, Tone
from calibrate.compare.similarity import SSIM_SETTINGS
from calibrate.files import write_whole
from calibrate.loop.compare import Closed, Half
from calibrate.loop.images import KEYS
from calibrate.loop.picture import draw
from calibrate.loop.scores import AGAIN, GOAL_POINTS, PairScore
from calibrate.loop.table import FILE as NUMBERS
from calibrate.loop.table import PAPER_ROBOT, LoopRecord, Table1Row
from calibrate.report.pages import render
from calibrate.report.pictures import difference, ink
from calibrate.report.wording import source_note
from sessions.cells import CsvWriter

HEADLINE = (Alignment.MM, Tone.BINARY)
PICTURE, PAGE, TABLE = "loop.png", "loop.html", "loop.csv"
SHEET_ROWS = slice(32, 96)
MAX_PAIRS_SHOWN = 150


def write_loop(closed: Closed, folder: Path, command: str) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(closed, folder / PICTURE)
    page = render(
        "loop.html.j2",
        header=closed.original.header,
        again=closed.again.header,
        source=closed.again.header.source,
        note=source_note(closed.again.header.source),
        model=closed.model,
        in_sample=closed.in_sample,
        goal=f"{GOAL_POINTS:g}",
        pairs=len(closed.paired.pairs),
        answer=answer(closed),
        verdicts=closed.verdicts,
        tables=_tables(closed.table),
        paper=PAPER_ROBOT,
        rows=_rows(closed),
        refused=closed.paired.refused,
        field=closed.field,
        ssim_settings=SSIM_SETTINGS,
        picture="data:image/png;base64," + base64.b64encode((folder / PICTURE).read_bytes()).decode(),
        provenance=list(_provenance(closed, command)),
    )
    write_whole(folder / TABLE, loop_csv(closed.scores, closed.again.header.source))
    write_whole(folder / NUMBERS, record_of(closed, command).to_json())
    write_whole(folder / PAGE, page)
    return folder / PAGE


def answer(closed: Closed) -> str:
    """What came out, in one sentence."""
    if not closed.verdicts:
        return "No cell of the original session was pressed twice, so its repeatability is not known."
    failed = [v for v in closed.verdicts if not v.holds]
    least = min(closed.verdicts, key=lambda v: v.difference)
    where = f"{least.measure.upper()}, {least.alignment}, {least.tone}"
    if not failed:
        return (
            f"The re-pressed strokes are as like their originals as the brush's own presses are to each other, or less "
            f"than {GOAL_POINTS:g} point behind, in all {len(closed.verdicts)} comparisons "
            f"(least: {least.difference:+.2f} points, {where})."
        )
    return (
        f"In {len(failed)} of {len(closed.verdicts)} comparisons the re-pressed strokes are more than {GOAL_POINTS:g} "
        f"point less like their originals than other presses of the same cell are (least: {least.difference:+.2f} "
        f"points, {where})."
    )


def summary(closed: Closed) -> Iterator[str]:
    """Lines for the terminal."""
    source = closed.again.header.source
    yield f"{len(closed.paired.pairs)} presses made again, {len(closed.paired.refused)} not compared ({source})"
    for alignment, tone in KEYS:
        rows = [row for row in closed.table if (row.alignment, row.tone) == (alignment, tone)]
        parts = "; ".join(f"{row.what} {row.csim[2]:.2f} / {row.ssim[2]:.2f}" for row in rows)
        yield f"{alignment}, {tone}, CSIM / SSIM: {parts}"
    yield answer(closed)


def loop_csv(scores: list[PairScore], source: str) -> str:
    """A row for every contestant against every original."""
    out = io.StringIO()
    writer = CsvWriter(out)
    columns = ["original", "again", "height_mm", "tilt_deg", "what", "alignment", "tone", "csim", "ssim", "source"]
    writer.writerow(columns)
    for s in scores:
        values = (f"{s.csim:.6f}", f"{s.ssim:.6f}", source)
        writer.writerow([s.original, s.again, *s.cell, s.what, s.alignment, s.tone, *values])
    return out.getvalue()


def record_of(closed: Closed, command: str) -> LoopRecord:
    """Everything but the images and the single scores, with its digest."""
    return LoopRecord(
        source=closed.again.header.source,
        original=closed.original.header.session_id,
        original_sha256=closed.original.sha256,
        again=closed.again.header.session_id,
        again_sha256=closed.again.sha256,
        model=closed.model,
        in_sample=closed.in_sample,
        mm_per_px=closed.field.mm_per_px,
        pairs=len(closed.paired.pairs),
        goal_points=GOAL_POINTS,
        table_1=tuple(closed.table),
        verdicts=tuple(closed.verdicts),
        refused=tuple(closed.paired.refused),
        software=closed.software,
        command=command,
    ).sealed()


def _tables(rows: list[Table1Row]) -> list[dict[str, Any]]:
    """A table an alignment and tone."""
    return [
        {"alignment": key[0], "tone": key[1], "rows": [row for row in rows if (row.alignment, row.tone) == key]}
        for key in KEYS
    ]


def _rows(closed: Closed) -> list[dict[str, Any]]:
    gray = (Alignment.MM, Tone.GRAY)
    chosen = {s.again: s for s in closed.scores if (s.what, s.alignment, s.tone) == (AGAIN, *HEADLINE)}
    pairs = sorted(closed.paired.pairs, key=lambda p: chosen[p.again.stroke_id].csim)
    out: list[dict[str, Any]] = []
    for pair in pairs[:MAX_PAIRS_SHOWN]:
        images = [
            image[SHEET_ROWS] for image in (pair.original.images[gray], pair.simulated[gray], pair.again.images[gray])
        ]
        out.append(
            {
                "original": pair.original,
                "again": pair.again,
                "score": chosen[pair.again.stroke_id],
                "images": [ink(image) for image in images],
                "difference": difference(images[0], images[2]),
            }
        )
    return out


def _provenance(closed: Closed, command: str) -> Iterator[tuple[str, str]]:
    for name, half in (("original", closed.original), ("re-pressed", closed.again)):
        yield from _of_half(name, half)
    header = closed.again.header
    yield "robot", f"{header.robot} {header.robot_firmware}".strip()
    yield "brush, ink, paper", ", ".join(part for part in (header.brush, header.ink, header.paper) if part)
    yield "recovered by", closed.model
    yield "compared with", f"{closed.software}, Python {platform.python_version()}"
    yield "command", command


def _of_half(name: str, half: Half) -> Iterator[tuple[str, str]]:
    yield f"{name}, source", str(half.header.source)
    yield f"{name}, recording", f"{half.recording.name}, sha256 {half.sha256}"
    if half.calibration is not None:
        yield f"{name}, calibration", f"{half.calibration.named}, pix2len {half.calibration.mm_per_px:.5f} mm/px"
