"""`brushloop write compare`: Figure 13, one self-contained HTML file, CSV and JSON of written characters."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.compare.place import Alignment, Image, Tone
from brushloop.calibrate.compare.score import Polarity
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.report import (
    Written,
    about,
    ink_uri,
    overlay,
    overlay_uri,
    picture_grid,
    png_uri,
    recording_facts,
    render,
    save_picture,
    show_picture,
    write_files,
)
from brushloop.calibrate.writing.learn import phase_table, round_of
from brushloop.calibrate.writing.plan import code_points
from brushloop.calibrate.writing.record import load_plan
from brushloop.calibrate.writing.scores import FILE as NUMBERS
from brushloop.calibrate.writing.scores import (
    HEADLINE,
    PAIRS,
    PAPER_ROWS,
    PICTURE,
    REFERENCE,
    Character,
    Table3Row,
    WritingComparison,
    WrittenRecord,
    WrittenScore,
    compare_written,
    read_reference,
)
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.sessions.disk import check_writable, csv_text
from brushloop.sessions.terminal import Progress, unseen

PAGE, TABLE = "written.html", "written.csv"


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """Which written characters are compared, and where the report goes."""

    session: Path
    plan: Path
    """The plan's folder, or its plan.json."""
    out: Path
    command: str
    """Named by the report as what made it."""
    references: tuple[str, ...] = ()
    """Pictures to compare with instead of the plan's font, as `CHARACTER=FILE`."""


def compare(request: CompareRequest, progress: Progress = unseen) -> Written:
    """Compare written characters with their simulation and reference; write the report. Raises `CalibrationError`."""
    check_writable(request.out)
    references: dict[str, tuple[str, Image]] = {}
    for words in request.references:
        name, equals, path = words.partition("=")
        if not name or not equals or not path:
            raise CalibrationError("--reference", f"{words!r}: expected CHARACTER=FILE, as 字=zi.png")
        references[name] = (Path(path).name, read_reference(Path(path)))
    written = compare_written(request.session, load_plan(request.plan), references, progress)
    report = write_written(written, request.out, request.command)
    return Written(report, (*summary(written), f"Picture: {request.out / PICTURE}", f"Report:  {report}"))


def write_written(written: WritingComparison, folder: Path, command: str) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(written, folder / PICTURE)
    picture = (folder / PICTURE).read_bytes()
    page = render(
        "written.html.j2",
        **about(written.header),
        names=" ".join(one.name for one in written.characters),
        writings=sum(len(one.captured) for one in written.characters),
        model=written.plan.model,
        cell_mm=written.plan.cell_mm,
        tables=_tables(written.table),
        paper_rows=PAPER_ROWS,
        characters=list(_characters(written)),
        refused=written.refused,
        cut=[stroke_id for one in written.characters for stroke_id in one.cut],
        ssim_settings=SSIM_SETTINGS,
        picture=png_uri(picture),
        provenance=[*_facts(written), ("compared with", made_by()), ("command", command)],
    )
    csv = written_csv(written.scores, str(written.header.source))
    record = record_of(written, command, picture)
    write_files(folder, {TABLE: csv, NUMBERS: record.to_json(), PAGE: page})
    return folder / PAGE


def summary(written: WritingComparison) -> Iterator[str]:
    """Lines for the terminal: the strict and the lenient comparison, ink = 1."""
    count = sum(len(one.captured) for one in written.characters)
    yield f"{count} characters written, {len(written.refused)} not compared ({written.header.source})"
    for row in written.table:
        if row.polarity is Polarity.INK and row.tone is Tone.BINARY:
            csim, ssim = ("{:.2f} / {:.2f} / {:.2f}".format(*of.range_and_avg) for of in (row.csim, row.ssim))
            yield f"{row.character} {row.alignment}, {row.pair}: CSIM {csim}, SSIM {ssim}"


def written_csv(scores: list[WrittenScore], source: str) -> str:
    """A row for every comparison."""
    head = ["character", "stroke_id", "pair", "alignment", "tone", "polarity", "csim", "ssim", "source"]
    rows = (
        (s.character, s.stroke_id, s.pair, s.alignment, s.tone, s.polarity, f"{s.csim:.6f}", f"{s.ssim:.6f}", source)
        for s in scores
    )
    return csv_text(head, rows)


def record_of(written: WritingComparison, command: str, picture: bytes) -> WrittenRecord:
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
        software=made_by(),
        command=command,
    ).sealed()


def draw(written: WritingComparison, path: Path) -> None:
    """Draw Figure 13, a row per character: reference, simulated, best and worst writing, all writings over reference.

    Raises OSError.
    """
    title = f"{written.header.session_id} ({written.header.source})"
    count = len(written.characters)
    figure, rows = picture_grid(count, 5, (13.0, 0.5 + 2.9 * count), title)
    for one, axes in zip(written.characters, rows, strict=True):
        names = ranked(written, one)
        reference = one.reference[Tone.GRAY]
        parts: tuple[tuple[str, Image], ...] = (
            (f"reference {code_points(one.name)}", reference),
            ("simulated", one.simulated[Tone.GRAY]),
            (f"captured, best of {len(one.captured)}", one.captured[names[0]][Tone.GRAY]),
            ("captured, worst", one.captured[names[-1]][Tone.GRAY]),
            ("blue: mean of all captured; orange: reference", overlay(reference, one.mean_ink())),
        )
        for axis, (text, image) in zip(axes, parts, strict=True):
            show_picture(axis, image, text, fontsize=8)
    save_picture(figure, path)


def ranked(written: WritingComparison, one: Character) -> list[str]:
    """Stroke ids by CSIM against the reference (mm, binary, ink = 1), best first."""
    found = {
        s.stroke_id: s.csim
        for s in written.scores
        if s.character == one.name and s.pair == REFERENCE and (s.alignment, s.tone, s.polarity) == HEADLINE
    }
    return sorted(found, key=lambda stroke_id: -found[stroke_id])


def _tables(table: list[Table3Row]) -> list[dict[str, Any]]:
    """A table for each alignment and tone, with both polarities."""
    out: list[dict[str, Any]] = []
    for tone in (Tone.BINARY, Tone.GRAY):
        for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM):
            rows = [row for row in table if (row.alignment, row.tone) == (alignment, tone)]
            rows.sort(key=lambda row: (PAIRS.index(row.pair), row.polarity is Polarity.PAPER))
            out.append({"alignment": alignment, "tone": tone, "rows": rows})
    return out


def _characters(written: WritingComparison) -> Iterator[dict[str, Any]]:
    for one in written.characters:
        reference = one.reference[Tone.GRAY]
        figure = written.plan.figure(one.name)
        rounds = [] if figure is None else [*figure.rounds, round_of(figure, one, written.plan.cell_mm)]
        yield {
            "rounds": rounds,
            "phases": phase_table(rounds),
            "name": one.name,
            "reference_name": one.reference_name,
            "reference": ink_uri(reference),
            "simulated": ink_uri(one.simulated[Tone.GRAY]),
            "mean": overlay_uri(one.mean_ink(), reference),
            "captured": [
                (stroke_id, ink_uri(one.captured[stroke_id][Tone.GRAY])) for stroke_id in ranked(written, one)
            ],
        }


def _facts(written: WritingComparison) -> Iterator[tuple[str, str]]:
    yield from recording_facts(
        written.header.model_copy(update={"protocol": ""}),  # the plan, point by point
        written.recording.name,
        written.recording_sha256,
        written.calibration,
    )
    for one in written.characters:
        yield f"reference of {one.name}", one.reference_name
    yield "planned and simulated by", written.plan.model
