"""The HTML report of presses: one self-contained file."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from brushloop.calibrate.artefact import FOLDER
from brushloop.calibrate.compare.paper import TABLE_3
from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.fit.artefact import FOLDER as FITS
from brushloop.calibrate.report import render, source_note
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate import candidates as who
from brushloop.calibrate.validate.report import figures, findings, tables
from brushloop.calibrate.validate.report.data import Extreme, Report, Session
from brushloop.calibrate.validate.report.figures import Curve
from brushloop.calibrate.validate.report.summary import Extremes
from brushloop.calibrate.validate.run import Outcome
from brushloop.calibrate.validate.sources import LoadedSession

CELL_COLUMNS = ("ccd-bsmg", who.GENERATOR_HELD_OUT, "ccd-bsm", who.FITTED_HELD_OUT, who.BEZIER_REFITTED, CEILING)
MAX_REFUSED = 200


def page_of(
    outcome: Outcome,
    report: Report,
    extremes: Extremes,
    curves: Sequence[Curve],
    beside: Sequence[str],
    figures_13: Sequence[str] = (),
    pages: Sequence[tuple[str, str]] = (),
) -> str:
    """The whole page. `beside` names the data files in its folder, `pages` is what `pages_beside` finds.

    `extremes` is what `report_of` returns beside the report.
    `figures_13` are pictures of written characters as data URIs, empty if missing.
    """
    shown = tables.candidate(report, report.shown)
    best, worst = extremes

    def pictured(found: Sequence[Extreme], rows: Sequence[int]) -> list[tuple[Extreme, dict[str, str]]]:
        images = (figures.triple(outcome, row, report.shown) for row in rows)
        return list(zip(found, images, strict=True))

    normal, strict = (Alignment.SIZE_NORMALISED, Tone.BINARY), (Alignment.MM, Tone.BINARY)
    return render(
        "presses.html.j2",
        report=report,
        name=", ".join(session.session_id for session in report.sessions[:4])
        + (f" and {len(report.sessions) - 4} more" if len(report.sessions) > 4 else ""),
        note=source_note(report.source),
        beside=beside,
        pages=pages,
        verdict=list(findings.verdict(report)),
        measured=findings.measured(report),
        findings=list(findings.findings(report)),
        trust=list(findings.trust(report)),
        order=findings.order(report),
        tables={
            "one": tables.table_1(report, *normal),
            "two": tables.table_2(report, *normal),
            # The paper has no such table, and its numbers could not be compared with these.
            "strict": [replace(row, paper=None) for row in tables.table_2(report, *strict) if row.ours],
        },
        table_three=tables.table_3(report),
        figures_13=[(record.session, uri) for record, uri in zip(report.written, figures_13, strict=False) if uri],
        paper_three=list(TABLE_3.values()),
        plot=figures.distributions(outcome, report),
        full=[
            {"alignment": alignment, "tone": tone, "rows": tables.full(report, alignment, tone)}
            for alignment, tone in itertools.product((Alignment.MM, Alignment.SIZE_NORMALISED), Tone)
        ],
        cells=_cells(report) if report.cells_told else None,
        samples=figures.samples(outcome, report.shown),
        side=figures.side_by_side(outcome, tuple(who.LAMBDAS)),
        shown=shown.label if shown is not None else "",
        best=pictured(report.best, best),
        worst=pictured(report.worst, worst),
        ablations=_ablations(outcome, report, curves),
        refused=report.refused[:MAX_REFUSED],
        more_refused=max(0, len(report.refused) - MAX_REFUSED),
        provenance=[*(_of_session(one) for one in report.sessions), *_of_others(report), _of_run(report)],
    )


def pages_beside(sessions: Sequence[LoadedSession], folder: Path) -> Iterator[tuple[str, str]]:
    """Name and relative address of the calibration's and the fit's page, where `folder` lies in the session's own."""
    for one in sessions:
        home = one.recording.path.parent
        if folder.resolve().parent != home.resolve():
            continue
        for name, made, kind in (("calibration", one.calibration, FOLDER), ("brush fit", one.fit, FITS)):
            if made is not None and (home / kind / f"{made.digest}.html").is_file():
                yield f"{name} of {one.header.session_id}", f"../{kind}/{made.digest}.html"


def _cells(report: Report) -> dict[str, Any]:
    columns = [name for name in CELL_COLUMNS if tables.candidate(report, name) is not None]
    cells = sorted({stat.cell for stat in report.stats if stat.cell is not None})
    rows: list[dict[str, Any]] = []
    for cell in cells:
        stats = [report.stat(name, Alignment.MM, Tone.BINARY, "csim", cell) for name in columns]
        rows.append({"cell": cell, "n": max((s.n for s in stats if s is not None), default=0), "stats": stats})
    labels = [found.label for name in columns if (found := tables.candidate(report, name)) is not None]
    return {"labels": labels, "rows": rows}


def _ablations(outcome: Outcome, report: Report, curves: Sequence[Curve]) -> dict[str, Any]:
    parts: dict[str, Any] = {}

    def rows(names: Sequence[str]) -> list[dict[str, str]]:
        known = [found for name in names if (found := tables.candidate(report, name)) is not None]
        return [
            {
                "label": one.label,
                "basis": one.basis,
                "mm": tables.pair(report, one.name, Alignment.MM),
                "normal": tables.pair(report, one.name, Alignment.SIZE_NORMALISED),
            }
            for one in known
        ]

    if any(tables.candidate(report, name) is not None for name in who.LAMBDAS):
        parts["lambdas"] = rows((*who.LAMBDAS, "ccd-bsm"))
        parts["lambda_images"] = figures.of_one_cell(outcome, (*who.LAMBDAS, "ccd-bsm"))
    if tables.candidate(report, who.FITTED_HELD_OUT) is not None or tables.candidate(report, who.FITTED) is not None:
        parts["calibrated"] = rows(
            (
                "ccd-bsmg",
                who.GENERATOR_HELD_OUT,
                "ccd-bsm",
                who.FITTED_HELD_OUT,
                who.FITTED,
                "bezier",
                who.BEZIER_REFITTED,
            )
        )
    if report.by_strokes:
        parts["steps"] = figures.by_strokes(report)
    if curves:
        parts["curves"] = figures.curves(curves)
    if not parts:
        return {}
    empty: dict[str, Any] = {"lambdas": [], "lambda_images": [], "calibrated": [], "steps": "", "curves": ""}
    return empty | parts


def _of_session(one: Session) -> list[tuple[str, str]]:
    rows = [
        ("session", one.session_id),
        ("source", str(one.source)),
        ("recording", f"{one.recording}, sha256 {one.recording_sha256}"),
        ("recorded with", one.recorded_with),
        ("robot", one.robot),
        ("camera", one.camera),
        ("brush", one.brush),
        ("ink, paper", ", ".join(part for part in (one.ink, one.paper) if part)),
        ("protocol", one.protocol),
        ("origin", one.origin),
        ("licence", one.licence),
        ("calibration", _calibration(one)),
        ("brush fit", one.fit),
        ("strokes", _strokes(one)),
        ("zero touch", "" if one.collected is None else ", ".join(one.collected.touches)),
    ]
    return [(name, text) for name, text in rows if text]


def _strokes(one: Session) -> str:
    collected = one.collected
    if collected is None:
        return f"{one.strokes} captured, {one.compared} compared"
    planned = "" if collected.planned is None else f"{collected.planned} planned, "
    return (
        f"{planned}{collected.photographed} photographed, {len(collected.pressed_again)} of them pressed again, "
        f"{len(collected.left_out)} left out, {one.strokes} counted, {one.compared} compared"
    )


def _calibration(one: Session) -> str:
    if one.mm_per_px is None or one.mm_per_px_interval is None:
        return one.calibration
    span = one.mm_per_px_interval
    return (
        f"{one.calibration}: pix2len {one.mm_per_px:.5f} mm/px (95 % {span.low:.5f} to {span.high:.5f}), "
        f"board residual {one.board_rms_px:.3f} px"
    )


def _of_others(report: Report) -> Iterator[list[tuple[str, str]]]:
    """The loops and the characters of the report, each with its own digest."""
    for loop in report.loops:
        yield [
            ("pressed again", f"{loop.again}, recording sha256 {loop.again_sha256}"),
            ("source", str(loop.source)),
            ("of", f"{loop.original}, recovered by {loop.model}{' (in sample)' if loop.in_sample else ''}"),
            ("strokes", f"{loop.pairs} pairs, {len(loop.refused)} strokes not compared"),
            ("compared with", f"{loop.software}; {loop.command}"),
            ("loop.json", f"digest {loop.digest}"),
        ]
    for record in report.written:
        yield [
            ("characters", f"{' '.join(record.characters)} in {record.session}"),
            ("source", str(record.source)),
            ("recording", f"sha256 {record.recording_sha256}"),
            ("brush", record.brush or "not named"),
            ("planned by", record.model),
            ("strokes", f"{len(record.refused)} not compared"),
            ("compared with", f"{record.software}; {record.command}"),
            ("written.json", f"digest {record.digest}"),
        ]


def _of_run(report: Report) -> list[tuple[str, str]]:
    return [
        ("validated with", ", ".join(f"{name} {number}" for name, number in report.software.items())),
        ("command", report.command),
        ("every score", f"scores.csv, sha256 {report.scores_sha256}"),
    ]
