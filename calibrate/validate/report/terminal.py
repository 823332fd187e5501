"""What `brushloop validate` prints of presses: the short of the report."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from rich.table import Column, Table

from calibrate.compare.field import Alignment, Tone
from calibrate.report.wording import source_note
from calibrate.validate.report import findings as words
from calibrate.validate.report import tables
from calibrate.validate.report.data import Report

MOST_REFUSED = 20
SHORT = {"fitted, held-out cells": ", held out", "fitted, in sample": ", in sample"}


def summary(report: Report) -> Iterator[Table | str]:
    """Renderables for the terminal."""
    names = ", ".join(session.session_id for session in report.sessions[:4])
    yield f"{names}: {source_note(report.source)}"
    yield words.measured(report)
    for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM):
        yield _scores(report, alignment)
    for one in tables.table_3(report):
        yield from _character(report, one)
    yield from words.findings(report)
    for point in words.trust(report):
        yield f"{'•' if point.good is None else '✓' if point.good else '✗'} {point.text}"
    for one in report.refused[:MOST_REFUSED]:
        yield f"not used: {one.session_id} {one.stroke_id}: {one.why}"
    if len(report.refused) > MOST_REFUSED:
        yield f"and {len(report.refused) - MOST_REFUSED} more, in the report"


def _scores(report: Report, alignment: Alignment) -> Table:
    # The paper's numbers stand beside the table that was made as its own was, as far as it tells.
    beside = alignment is Alignment.SIZE_NORMALISED
    columns = ["model", "n", "CSIM max", "min", "avg", "SSIM max", "min", "avg", *(["paper's avg"] if beside else [])]
    title = f"{alignment}, binary, ink = 1, percent ({report.label})"
    out = Table(*columns, title=title)
    others = tables.robot_writing(report, alignment, Tone.BINARY)
    for row in (*tables.table_2(report, alignment, Tone.BINARY), *others):
        if row.ours is None:
            continue
        told = f"{row.paper[2]:.2f} / {row.paper[5]:.2f}" if row.paper is not None else ""
        cells = [row.label + SHORT.get(row.basis, ""), str(row.n), *(f"{v:.2f}" for v in row.ours)]
        out.add_row(*cells, *([told] if beside else []))
    return out


def _character(report: Report, one: tables.Written) -> Iterator[Table]:
    """A table for each alignment and polarity."""
    for alignment, rows in ((Alignment.SIZE_NORMALISED, one.paper_like), (Alignment.MM, one.strict)):
        for polarity, group in itertools.groupby(rows, key=lambda row: row.basis.partition(";")[0]):
            beside = alignment is Alignment.SIZE_NORMALISED
            columns = ["n", "CSIM\nmax", "min", "avg", "SSIM\nmax", "min", "avg", *(["paper's avg"] if beside else [])]
            title = f"Table 3: {one.character}, {alignment}, binary, {polarity}, percent ({report.label})"
            out = Table(Column("", min_width=len("simulated")), *columns, title=title)
            for row in group:
                assert row.ours is not None, "rows of Table 3 are rows of ours"
                told = f"{row.paper[2]:.2f} / {row.paper[5]:.2f}" if row.paper is not None else ""
                cells = [row.label, str(row.n), *(f"{value:.2f}" for value in row.ours)]
                out.add_row(*cells, *([told] if beside else []))
            yield out
