"""The HTML report of presses: one self-contained file. Every plot shows its source in the picture itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from brushloop.calibrate.artefact import FOLDER
from brushloop.calibrate.compare import KEYS, TABLE_3, Key
from brushloop.calibrate.fit.fit import FOLDER as FITS
from brushloop.calibrate.report import (
    recording_facts,
    render,
    source_note,
)
from brushloop.calibrate.scores import MEASURES, Stat
from brushloop.calibrate.stats import CEILING, Cell
from brushloop.calibrate.validate import figures, findings
from brushloop.calibrate.validate.models import (
    BEZIER_REFITTED,
    FITTED_HELD_OUT,
    FittedSession,
    ModelInfo,
)
from brushloop.calibrate.validate.run import Outcome
from brushloop.calibrate.validate.tables import NORMAL, STRICT, Report, Session, TableRow, table_1, table_2, table_3

CELL_COLUMNS = ("ccd-bsmg", "ccd-bsm", FITTED_HELD_OUT, BEZIER_REFITTED, CEILING)
MAX_REFUSED = 200
MAX_SAMPLES = 15


def page_of(
    outcome: Outcome,
    report: Report,
    curves: Sequence[figures.Curve],
    beside: Sequence[str],
    figures_13: Sequence[tuple[str, str]] = (),
    pages: Sequence[tuple[str, str]] = (),
) -> str:
    """The whole page. `beside` names the data files in its folder, `pages` is what `pages_beside` finds.

    `figures_13` are sessions of characters and their pictures as data URIs.
    """
    shown, names = report.model(report.shown), [session.session_id for session in report.sessions]
    best, worst = figures.extremes(outcome, report.shown)
    columns = [model for name in CELL_COLUMNS if (model := report.model(name)) is not None]
    return render(
        "report.html.j2",
        report=report,
        name=", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else ""),
        note=source_note(report.source),
        beside=beside,
        pages=pages,
        verdict=list(findings.verdict(report)),
        measured=findings.measured(report),
        trust=list(findings.trust(report)),
        order=findings.order(report),
        table_one=table_1(report),
        table_two=table_2(report),
        table_three=list(_table_three(report)),
        figures_13=figures_13,
        paper_three=list(TABLE_3.values()),
        plot=figures.distributions(outcome, report),
        keys=KEYS,
        headline=list(findings.headline(report)),
        scores=[(key, _scores(report, key)) for key in KEYS],
        cell_columns=columns,
        cells=[_cell(report, cell, columns) for cell in report.cells],
        samples=[figures.pictured(outcome, k, report.shown) for k in figures.first_of_cells(outcome, MAX_SAMPLES)],
        side=figures.side_by_side(outcome),
        shown=shown.label if shown is not None else "",
        best=[figures.pictured(outcome, k, report.shown) for k in best],
        worst=[figures.pictured(outcome, k, report.shown) for k in worst],
        steps=figures.by_strokes(report) if report.by_strokes else "",
        curves=figures.losses(curves) if curves else "",
        refused=report.refused[:MAX_REFUSED],
        more_refused=max(0, len(report.refused) - MAX_REFUSED),
        provenance=list(map(provenance, report.sessions)),
        software=", ".join(f"{name} {number}" for name, number in report.software.items()),
    )


def pages_beside(sessions: Sequence[FittedSession], folder: Path) -> Iterator[tuple[str, str]]:
    """Name and relative address of the calibration's and the fit's page, where `folder` lies in the session's own."""
    for session in sessions:
        home = session.recording.path.parent
        if folder.resolve().parent != home.resolve():
            continue
        for name, artefact, kind in (("calibration", session.calibration, FOLDER), ("brush fit", session.fit, FITS)):
            if artefact is not None and (home / kind / f"{artefact.digest}.html").is_file():
                yield f"{name} of {session.header.session_id}", f"../{kind}/{artefact.digest}.html"


def _table_three(report: Report) -> Iterator[tuple[str, list[TableRow]]]:
    """Title and rows of Table 3 of every character in either alignment."""
    for record in report.written:
        where = f"written in {record.session} with {record.brush or 'an unnamed brush'}"
        where += f" on paper cells of {record.cell_mm:g} mm"
        for name in record.characters:
            yield f"{name}, {where} — {NORMAL[0]}, binary", table_3(record, name, NORMAL[0])
            title = f"{name}, {where} — {STRICT[0]}, binary: where size and place count"
            yield title, table_3(record, name, STRICT[0])


def _scores(report: Report, key: Key) -> list[tuple[ModelInfo, Stat, int, int]]:
    """Each model with its scores in one alignment and tone, and its rank by average CSIM and SSIM."""
    rows = [(model, stat) for model in report.models if (stat := report.stat(model.name, key)) is not None]
    by_csim, by_ssim = (np.argsort(np.argsort([-getattr(stat, of).avg for _, stat in rows])) for of in MEASURES)
    return [(*row, int(first), int(second)) for row, first, second in zip(rows, by_csim, by_ssim, strict=True)]


def _cell(report: Report, cell: Cell, columns: Sequence[ModelInfo]) -> tuple[Cell, int, list[Stat | None]]:
    """A cell, its number of presses, and the scores of these models there."""
    stats = [report.stat(model.name, STRICT, cell) for model in columns]
    return cell, max((stat.csim.n for stat in stats if stat is not None), default=0), stats


def provenance(session: Session) -> list[tuple[str, str]]:
    """Name and text of what is known of a recording."""
    collected, counts = session.collected, f"{session.strokes} captured, {session.compared} compared"
    if collected is not None:
        planned = "" if collected.planned is None else f"{collected.planned} planned, "
        counts = (
            f"{planned}{collected.photographed} photographed, {len(collected.pressed_again)} of them pressed again, "
            f"{len(collected.left_out)} left out, {session.strokes} counted, {session.compared} compared"
        )
    touches = "" if collected is None else ", ".join(collected.touches)
    used = (("brush fit", session.fit), ("strokes", counts), ("zero touch", touches))
    facts = recording_facts(session.header, session.recording, session.recording_sha256, session.calibration)
    return [*facts, *((name, text) for name, text in used if text)]
