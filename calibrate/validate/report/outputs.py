"""Outputs of a report other than its page: scores as CSV and Parquet, tables as CSV, and the terminal summary."""

from __future__ import annotations

import hashlib
import importlib
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.table import Column, Table

from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import replacing, write_whole
from brushloop.calibrate.loop.scores import AGAIN
from brushloop.calibrate.report import source_label, source_note
from brushloop.calibrate.validate.report import findings, tables
from brushloop.calibrate.validate.report.data import Report, Stat
from brushloop.calibrate.validate.run import REPEATED, Outcome
from brushloop.sessions.disk import csv_text
from brushloop.sessions.terminal import narrow

COLUMNS = (
    *("session_id", "stroke_id", "depth_mm", "reached_mm", "tilt_deg", "model", "alignment", "tone"),
    *("csim", "ssim", "source"),
)
"""`depth_mm` was commanded; `reached_mm` is empty where the recording does not say what the arm reached."""
NUMBERS = ("depth_mm", "reached_mm", "tilt_deg", "csim", "ssim")
MAX_REFUSED = 20
"""Refused strokes listed on the terminal."""
SHORT = {"fitted, held-out cells": ", held out", "fitted, in sample": ", in sample"}
"""What a candidate knows of the strokes, shortened for the terminal."""
Cells = tuple[str, str, float, float | None, float, str, str, str, float, float, str]


def score_rows(outcome: Outcome) -> Iterator[Cells]:
    """Yield one row per score, by session and order of capture."""
    labels = {one.header.session_id: source_label(one.header.source, [one.header.brush]) for one in outcome.sessions}
    for s in outcome.every_score():
        pressed = s.condition.depth_mm, s.reached_mm, s.condition.tilt_deg
        compared = s.model, str(s.alignment), str(s.tone), s.csim, s.ssim
        yield s.session, s.stroke_id, *pressed, *compared, labels[s.session]


def write_csv(outcome: Outcome, path: Path) -> str:
    """Write every score and return the file's SHA-256. Raises OSError and leaves no partial file."""
    rows = (
        [f"{v:.8f}" if name in ("csim", "ssim") else v for name, v in zip(COLUMNS, row, strict=True)]
        for row in score_rows(outcome)
    )
    text = csv_text(COLUMNS, rows)
    write_whole(path, text)
    return hashlib.sha256(text.encode()).hexdigest()


def write_parquet(outcome: Outcome, path: Path) -> None:
    """Write the same rows as Parquet. Raises `CalibrationError` if pyarrow is not installed."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise CalibrationError("--parquet", "needs pyarrow: pip install 'brushloop[parquet]'") from None
    kinds = [pa.float64() if name in NUMBERS else pa.string() for name in COLUMNS]
    label = source_label(outcome.sessions[0].header.source, (one.header.brush for one in outcome.sessions))
    schema: Any = pa.schema(list(zip(COLUMNS, kinds, strict=True)), metadata={"source": label})
    columns = [list(column) for column in zip(*score_rows(outcome), strict=True)] or [[] for _ in COLUMNS]
    with replacing(path) as part:
        pq.write_table(pa.table(columns, schema=schema), part)


def summary_csv(report: Report) -> str:
    """Return every statistic, per cell and overall; “robot writing” is what `brushloop loop` pressed again."""
    head = ("model", "alignment", "tone", "measure", "depth_mm", "tilt_deg", "n", "max", "min", "avg")
    ends = ("avg_low", "avg_high", "median", "median_low", "median_high", "below_ceiling", "source")
    rows = [(*_stat_row(stat), report.label) for stat in report.stats]
    return csv_text((*head, *ends), [*rows, *_loop_rows(report)])


def _stat_row(stat: Stat) -> tuple[object, ...]:
    cell = stat.cell if stat.cell is not None else ("", "")
    low, high = (stat.avg_interval.low, stat.avg_interval.high) if stat.avg_interval is not None else ("", "")
    middle = (stat.median_interval.low, stat.median_interval.high) if stat.median_interval is not None else ("", "")
    known = (stat.model, stat.alignment, stat.tone, stat.measure, *cell, stat.n, stat.max, stat.min, stat.avg)
    return (*known, low, high, stat.median, *middle, stat.below)


def _loop_rows(report: Report) -> Iterator[tuple[object, ...]]:
    for loop in report.loops:
        for row in loop.table_1:
            if row.what != AGAIN:
                continue
            name = f"{REPEATED} ({loop.again})"
            for measure, three, median in (("csim", row.csim, row.csim_median), ("ssim", row.ssim, row.ssim_median)):
                known = (name, row.alignment, row.tone, measure, "", "", row.n, *three)
                yield (*known, "", "", median, "", "", "", str(row.source))


def table_3_csv(report: Report) -> str:
    """Return every row of Table 3, with the paper's numbers in the corresponding rows."""
    head = ["session_id", "character", "reference", "model", "compared", "alignment", "tone", "polarity", "n"]
    head += [f"{of}_{what}" for of in ("csim", "ssim") for what in ("max", "min", "avg", "median")]
    head += ["paper_row", *(f"paper_{of}_{what}" for of in ("csim", "ssim") for what in ("max", "min", "avg"))]
    none = ("", "", "")
    rows = [
        (
            *(row.session_id, row.character, row.reference, row.model, row.pair, row.alignment, row.tone, row.polarity),
            *(row.n, *row.csim, row.csim_median, *row.ssim, row.ssim_median),
            *(row.paper_row or "", *(row.paper_csim or none), *(row.paper_ssim or none), str(row.source)),
        )
        for record in report.written
        for row in record.table_3
    ]
    return csv_text((*head, "source"), rows)


def summary(report: Report) -> Iterator[Table | str]:
    """Yield tables and lines for the terminal."""
    names = ", ".join(session.session_id for session in report.sessions[:4])
    yield f"{names}: {source_note(report.source)}"
    yield findings.measured(report)
    for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM):
        yield _scores(report, alignment)
    for one in tables.table_3(report):
        yield from _character(report, one)
    yield from findings.findings(report)
    for point in findings.trust(report):
        yield f"{'•' if point.good is None else '✓' if point.good else '✗'} {point.text}"
    for one in report.refused[:MAX_REFUSED]:
        yield f"not used: {one.session_id} {one.stroke_id}: {one.why}"
    if len(report.refused) > MAX_REFUSED:
        yield f"and {len(report.refused) - MAX_REFUSED} more, in the report"


def _scores(report: Report, alignment: Alignment) -> Table:
    # The paper's numbers are shown only in the table made in the same way, as far as the paper describes it.
    with_paper = alignment is Alignment.SIZE_NORMALISED
    title = f"{alignment}, binary, ink = 1, percent ({report.label})"
    out = Table("model", *_heads(with_paper=with_paper), title=title)
    others = tables.robot_writing(report, alignment, Tone.BINARY)
    for row in (*tables.table_2(report, alignment, Tone.BINARY), *others):
        if row.ours is not None:
            out.add_row(row.label + SHORT.get(row.basis, ""), *_cells(row, row.ours, with_paper=with_paper))
    return out


def _character(report: Report, one: tables.CharacterTables) -> Iterator[Table]:
    """Yield one table per alignment and polarity."""
    for alignment, rows in ((Alignment.SIZE_NORMALISED, one.paper_like), (Alignment.MM, one.strict)):
        for polarity, group in itertools.groupby(rows, key=lambda row: row.basis.partition(";")[0]):
            with_paper = alignment is Alignment.SIZE_NORMALISED
            title = f"Table 3: {one.character}, {alignment}, binary, {polarity}, percent ({report.label})"
            out = Table(Column("", min_width=len("simulated")), *_heads(with_paper=with_paper), title=title)
            for row in group:
                assert row.ours is not None, "rows of Table 3 are rows of ours"
                out.add_row(row.label, *_cells(row, row.ours, with_paper=with_paper))
            yield out


def _heads(*, with_paper: bool) -> list[str]:
    """Heads of the columns of scores; a narrow terminal has room for averages only."""
    scores = ["CSIM\navg", "SSIM\navg"] if narrow() else ["CSIM\nmax", "min", "avg", "SSIM\nmax", "min", "avg"]
    return ["n", *scores, *(["paper's avg"] if with_paper else [])]


def _cells(row: tables.PaperRow, ours: Sequence[float | None], *, with_paper: bool) -> list[str]:
    scores = [ours[2], ours[5]] if narrow() else ours
    paper = f"{row.paper[2]:.2f} / {row.paper[5]:.2f}" if row.paper is not None else ""
    words = ("" if score is None else f"{score:.2f}" for score in scores)
    return [str(row.n), *words, *([paper] if with_paper else [])]
