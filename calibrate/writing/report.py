"""`brushloop write compare`: Figure 13, one self-contained HTML file, CSV and JSON of written characters."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.compare.place import Alignment, Image, Polarity, Tone
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
from brushloop.calibrate.writing.plan import code_points
from brushloop.calibrate.writing.record import load_plan
from brushloop.calibrate.writing.scores import (
    FILE,
    PAIRS,
    PAPER_ROWS,
    PICTURE,
    Character,
    Table3Row,
    WritingComparison,
    WrittenRecord,
    compare_written,
    read_reference,
    round_of,
)
from brushloop.model.characters.plan import Phase
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
        name, _, path = words.partition("=")
        if not name or not path:
            raise CalibrationError("--reference", f"{words!r}: expected CHARACTER=FILE, as 字=zi.png")
        references[name] = (Path(path).name, read_reference(Path(path)))
    written = compare_written(request.session, load_plan(request.plan), references, progress)
    report = write_written(written, request.out, request.command)
    return Written(report, (*summary(written), f"Picture: {request.out / PICTURE}", f"Report:  {report}"))


def summary(written: WritingComparison) -> Iterator[str]:
    """Lines for the terminal: the strict and the lenient comparison, ink = 1."""
    count = sum(len(one.captured) for one in written.characters)
    yield f"{count} characters written, {len(written.refused)} not compared ({written.header.source})"
    for row in written.table:
        if row.polarity is Polarity.INK and row.tone is Tone.BINARY:
            csim, ssim = ("{:.2f} / {:.2f} / {:.2f}".format(*of.range_and_avg) for of in (row.csim, row.ssim))
            yield f"{row.character} {row.alignment}, {row.pair}: CSIM {csim}, SSIM {ssim}"


def write_written(written: WritingComparison, folder: Path, command: str) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(written, folder / PICTURE)
    picture = (folder / PICTURE).read_bytes()
    header, plan, table = written.header, written.plan, written.table
    facts = recording_facts(
        header.model_copy(update={"protocol": ""}),  # the plan, point by point
        written.recording.name,
        written.recording_sha256,
        written.calibration,
    )
    record = WrittenRecord(
        source=header.source,
        session=header.session_id,
        recording_sha256=written.recording_sha256,
        brush=header.brush,
        model=plan.model,
        cell_mm=plan.cell_mm,
        table_3=tuple(table),
        refused=written.refused,
        figure_13_sha256=hashlib.sha256(picture).hexdigest(),
        software=made_by(),
        command=command,
    )
    page = render(
        "written.html.j2",
        **about(header),
        names=" ".join(one.name for one in written.characters),
        writings=sum(len(one.captured) for one in written.characters),
        model=plan.model,
        cell_mm=plan.cell_mm,
        tables=_tables(table),
        paper_rows=PAPER_ROWS,
        characters=[_character(written, one) for one in written.characters],
        refused=written.refused,
        cut=[stroke_id for one in written.characters for stroke_id in one.cut],
        ssim_settings=SSIM_SETTINGS,
        picture=png_uri(picture),
        provenance=[*facts, ("compared with", made_by()), ("command", command)],
    )
    head = ["character", "stroke_id", "pair", "alignment", "tone", "polarity", "csim", "ssim", "source"]
    rows = (
        (s.character, s.stroke_id, s.pair, s.alignment, s.tone, s.polarity, f"{s.csim:.6f}", f"{s.ssim:.6f}")
        for s in written.scores
    )
    csv = csv_text(head, ((*row, str(header.source)) for row in rows))
    write_files(folder, {TABLE: csv, FILE: record.sealed().to_json(), PAGE: page})
    return folder / PAGE


def draw(written: WritingComparison, path: Path) -> None:
    """Draw Figure 13, a row per character: reference, simulated, best and worst writing, all writings over reference.

    Raises OSError.
    """
    title = f"{written.header.session_id} ({written.header.source})"
    count = len(written.characters)
    figure, rows = picture_grid(count, 5, (13.0, 0.5 + 2.9 * count), title)
    for one, axes in zip(written.characters, rows, strict=True):
        names = written.ranked(one)
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


def _tables(table: list[Table3Row]) -> list[dict[str, Any]]:
    """A table for each alignment and tone, with both polarities."""
    out: list[dict[str, Any]] = []
    for tone, alignment in itertools.product(Tone, (Alignment.SIZE_NORMALISED, Alignment.MM)):
        rows = [row for row in table if (row.alignment, row.tone) == (alignment, tone)]
        rows.sort(key=lambda row: (PAIRS.index(row.pair), row.polarity is Polarity.PAPER))
        out.append({"alignment": alignment, "tone": tone, "rows": rows})
    return out


def _character(written: WritingComparison, one: Character) -> dict[str, Any]:
    """A character as the page shows it."""
    reference, figure = one.reference[Tone.GRAY], written.plan.figure(one.name)
    rounds = [] if figure is None else [*figure.rounds, round_of(figure, one, written.plan.cell_mm)]
    return {
        "rounds": rounds,
        "phases": [str(phase) for phase in Phase if any(phase in one_round.lost_percent for one_round in rounds)],
        "name": one.name,
        "reference_name": one.reference_name,
        "reference": ink_uri(reference),
        "simulated": ink_uri(one.simulated[Tone.GRAY]),
        "mean": overlay_uri(one.mean_ink(), reference),
        "captured": [(stroke_id, ink_uri(one.captured[stroke_id][Tone.GRAY])) for stroke_id in written.ranked(one)],
    }
