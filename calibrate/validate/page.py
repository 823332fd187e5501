"""The HTML report of presses: one self-contained file. Every plot shows its source in the picture itself."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.artefact import FOLDER
from brushloop.calibrate.compare.paper import TABLE_3
from brushloop.calibrate.compare.place import KEYS, Alignment, Key, Pixels, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.fit.artefact import FOLDER as FITS
from brushloop.calibrate.report import BLUE, ORANGE, dress, ink_uri, overlay_uri, plot, plot_uri, render, source_note
from brushloop.calibrate.scores import Row
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate import findings, tables
from brushloop.calibrate.validate.inputs import FittedSession
from brushloop.calibrate.validate.models import (
    BEZIER_REFITTED,
    FITTED,
    FITTED_HELD_OUT,
    GENERATOR_HELD_OUT,
    LAMBDAS,
)
from brushloop.calibrate.validate.report import Report, Session
from brushloop.calibrate.validate.run import Outcome
from brushloop.model.ccdbsm import DomainError

CELL_COLUMNS = ("ccd-bsmg", GENERATOR_HELD_OUT, "ccd-bsm", FITTED_HELD_OUT, BEZIER_REFITTED, CEILING)
CALIBRATED = (
    *("ccd-bsmg", GENERATOR_HELD_OUT, "ccd-bsm", FITTED_HELD_OUT),
    *(FITTED, "bezier", BEZIER_REFITTED),
)
NORMAL, STRICT = (Alignment.SIZE_NORMALISED, Tone.BINARY), (Alignment.MM, Tone.BINARY)
GRAY_MM: Key = (Alignment.MM, Tone.GRAY)
MAX_REFUSED = 200
ROWS = slice(32, 96)
"""Rows to show: the middle half of a field, as a press is at most half as thick as the field is high."""
MAX_POINTS = 200
LABEL_CHARS = 120
"""As many fit on a line over two plots; a label that names a simulated brush is longer."""
MAX_SAMPLES, MAX_CELLS, EXTREMES = 15, 5, 6
MAX_CURVE_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Curve:
    """A training, from its folder: validation loss by step."""

    name: str
    steps: tuple[int, ...]
    losses: tuple[float, ...]


def read_curve(text: str) -> Curve:
    """Read `NAME=FOLDER`, a folder that `brushloop train` wrote. Raises `CalibrationError` if it holds no curve."""
    name, _, folder = text.partition("=")
    if not name or not folder:
        raise CalibrationError(f"--curves {text}", "expected NAME=FOLDER")
    path = Path(folder) / "validation.csv"
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_CURVE_BYTES).decode())))
        steps = tuple(int(row["step"]) for row in rows)
        losses = tuple(float(row["mse"]) for row in rows)
    except (KeyError, TypeError, ValueError):
        raise CalibrationError(str(path), "is not a table of validation losses (step, mse)") from None
    if not steps:
        raise CalibrationError(str(path), "holds no validation yet")
    return Curve(name, steps, losses)


def page_of(
    outcome: Outcome,
    report: Report,
    curves: Sequence[Curve],
    beside: Sequence[str],
    figures_13: Sequence[str] = (),
    pages: Sequence[tuple[str, str]] = (),
) -> str:
    """The whole page. `beside` names the data files in its folder, `pages` is what `pages_beside` finds.

    `figures_13` are pictures of written characters as data URIs, empty if missing.
    """
    shown, names = report.model(report.shown), [session.session_id for session in report.sessions]
    best, worst = _extremes(outcome, report.shown)
    return render(
        "presses.html.j2",
        report=report,
        name=", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else ""),
        note=source_note(report.source),
        beside=beside,
        pages=pages,
        verdict=list(findings.verdict(report)),
        measured=findings.measured(report),
        findings=list(findings.findings(report)),
        trust=list(findings.trust(report)),
        order=findings.order(report),
        tables={
            "one": tables.table_1(report, NORMAL),
            "two": tables.table_2(report, NORMAL),
            # The paper has no such table, and its numbers could not be compared with these.
            "strict": [replace(row, paper=None) for row in tables.table_2(report, STRICT) if row.ours],
        },
        table_three=tables.table_3(report),
        figures_13=[(record.session, uri) for record, uri in zip(report.written, figures_13, strict=False) if uri],
        paper_three=list(TABLE_3.values()),
        plot=_distributions(outcome, report),
        full=[
            {"alignment": alignment, "tone": tone, "rows": tables.full(report, (alignment, tone))}
            for alignment, tone in KEYS
        ],
        cells=_cells(report) if report.cells_told else None,
        samples=[_pictured(outcome, k, report.shown) for k in _first_of_cells(outcome, MAX_SAMPLES)],
        side=_side_by_side(outcome),
        shown=shown.label if shown is not None else "",
        best=[_pictured(outcome, k, report.shown) for k in best],
        worst=[_pictured(outcome, k, report.shown) for k in worst],
        ablations=_ablations(outcome, report, curves),
        refused=report.refused[:MAX_REFUSED],
        more_refused=max(0, len(report.refused) - MAX_REFUSED),
        provenance=[*map(provenance, report.sessions), *_of_others(report), _of_run(report)],
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


def _extremes(outcome: Outcome, model: str) -> tuple[list[int], list[int]]:
    """Rows of the best and of the worst strokes of a model, from the outermost; none without a model."""
    if not model:
        return [], []
    csim = outcome.scores.of_key(model, STRICT)[:, 0]
    known = np.flatnonzero(np.isfinite(csim))
    order = known[np.argsort(csim[known], kind="stable")]
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[::-1][:count].tolist(), order[:count].tolist()


def _pictured(outcome: Outcome, k: int, model: str) -> dict[str, Any]:
    """A press with what the model predicts for it, their difference, and their scores: the paper's figures 7 and 8."""
    row, captured = outcome.scores.rows[k], outcome.scores.rows[k].image(GRAY_MM)
    image = _predicted(outcome, row, model)
    images = {"captured": _ink(captured)}
    if image is not None:
        a, b = (np.asarray(one[ROWS] / 255.0, np.float32) for one in (captured, image))
        images |= {"predicted": ink_uri(b), "difference": overlay_uri(a, b)}
    csim, ssim = 100.0 * outcome.scores.of_key(model, STRICT)[k] if model else (np.nan, np.nan)
    return {"row": row, "images": images, "scored": bool(np.isfinite(csim)), "csim": csim, "ssim": ssim}


def _side_by_side(outcome: Outcome) -> dict[str, Any]:
    """Some captures next to the prediction of every model: the paper's figures 10 and 11."""
    every = (model.info for group in outcome.models.values() for model in group)
    labels = {info.name: info.label for info in every if info.name not in LAMBDAS}
    lines: list[dict[str, Any]] = []
    for k in _first_of_cells(outcome, MAX_CELLS):
        row = outcome.scores.rows[k]
        images = [_predicted(outcome, row, name) for name in labels]
        shown = ["" if image is None else _ink(image) for image in images]
        lines.append({"row": row, "captured": _ink(row.image(GRAY_MM)), "models": shown})
    return {"labels": list(labels.values()), "lines": lines}


def _of_one_cell(outcome: Outcome, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """(label, image) of a capture of the middle cell, and of these models' predictions: the paper's figure 3."""
    chosen = _first_of_cells(outcome, MAX_SAMPLES)
    if not chosen:
        return
    row = outcome.scores.rows[chosen[len(chosen) // 2]]
    labels = {model.name: model.info.label for model in outcome.models[row.session]}
    yield "captured", _ink(row.image(GRAY_MM))
    for name in names:
        image = _predicted(outcome, row, name)
        if image is not None:
            yield labels[name], _ink(image)


def _first_of_cells(outcome: Outcome, most: int) -> list[int]:
    """The first capture of each condition; with more than `most` of them, of evenly spaced ones."""
    first = [int(rows[0]) for rows in outcome.scores.conditions().values()]
    count = min(len(first), most)
    return [first[n * (len(first) - 1) // max(count - 1, 1)] for n in range(count)]


def _predicted(outcome: Outcome, row: Row, name: str) -> Pixels | None:
    """(128, 128) gray on the millimetre field, or None if the model does not predict this press."""
    model = next((model for model in outcome.models[row.session] if model.name == name), None)
    try:
        return None if model is None else model.predict(row.condition)[KEYS.index(GRAY_MM)]
    except DomainError:
        return None


def _ink(image: Pixels) -> str:
    return ink_uri(np.asarray(image[ROWS] / 255.0, np.float32))


def _distributions(outcome: Outcome, report: Report) -> str:
    """CSIM of every stroke by model in both alignments, with the average and its interval."""
    models = [model for name in outcome.scores.models if (model := report.model(name)) is not None]
    figure, axes = plot(1, 2, (11.0, 0.9 + 0.36 * len(models)))
    for axis, key in zip(axes, (STRICT, NORMAL), strict=True):
        rng = np.random.default_rng(0)  # jitter only, so that points do not hide each other
        for place, model in enumerate(reversed(models)):
            values = 100.0 * outcome.scores.of_key(model.name, key)[:, 0]
            values = values[np.isfinite(values)]
            stat = report.stat(model.name, *key, "csim")
            if stat is None:
                continue
            if len(values) > 3 and np.ptp(values) > 1e-6:
                parts: Any = axis.violinplot([values], [place], orientation="horizontal", widths=0.8, showextrema=False)
                for body in parts["bodies"]:
                    body.set(facecolor=BLUE, alpha=0.18)
            some = values[:: max(1, -(-len(values) // MAX_POINTS))]
            axis.plot(some, place + 0.14 * rng.uniform(-1, 1, len(some)), ".", ms=3, alpha=0.5, color=BLUE)
            if stat.avg_low is not None:
                span = [stat.avg_low, stat.avg_high]
                axis.plot(span, [place] * 2, color=ORANGE, lw=2.5, solid_capstyle="butt")
            axis.plot(stat.avg, place, "|", ms=15, mew=2.5, color=ORANGE)
        axis.set_yticks(range(len(models)), [model.label for model in reversed(models)])
        dress(axis, f"{key[0]}, binary", "CSIM, %", grid="x")
    axes[1].set_yticklabels([])
    figure.suptitle(textwrap.fill(report.label, LABEL_CHARS), fontsize=10)
    return plot_uri(figure)


def _by_strokes(report: Report) -> str:
    """CSIM on presses that were not fitted, against the number of presses that were."""
    figure, axis = plot(1, 1, (6.4, 3.2))
    for name, colour in (("CCD-BSM", ORANGE), ("Bézier", BLUE)):
        counts = sorted({step.strokes for step in report.by_strokes if step.model == name})
        means = [np.mean([s.csim for s in report.by_strokes if (s.model, s.strokes) == (name, n)]) for n in counts]
        if counts:
            axis.plot(counts, means, "o-", ms=4, color=colour, label=f"{name} fitted")
    ticks = sorted({step.strokes for step in report.by_strokes})
    axis.set_xscale("log")
    axis.set_xticks(ticks, [str(n) for n in ticks])
    axis.minorticks_off()
    title = f"mm, binary\n{textwrap.fill(report.label, LABEL_CHARS // 2)}"
    dress(axis, title, "presses that were fitted", "CSIM on all others, %", legend=True)
    return plot_uri(figure)


def _curves(curves: Sequence[Curve]) -> str:
    """Validation losses of trained generators: the paper's figures 9 and 12."""
    figure, axis = plot(1, 1, (6.4, 3.2))
    for curve in curves:
        axis.semilogy(curve.steps, curve.losses, ".-", ms=4, label=curve.name)
    title = "networks trained on exact images of stroke models"
    dress(axis, title, "step", "validation loss (MSE)", legend=True)
    return plot_uri(figure)


def _cells(report: Report) -> dict[str, Any]:
    """Average CSIM of the models of `CELL_COLUMNS` in each cell."""
    columns = [model for name in CELL_COLUMNS if (model := report.model(name)) is not None]
    rows: list[dict[str, Any]] = []
    for cell in sorted({stat.cell for stat in report.stats if stat.cell is not None}):
        stats = [report.stat(model.name, *STRICT, "csim", cell) for model in columns]
        rows.append({"cell": cell, "n": max((s.n for s in stats if s is not None), default=0), "stats": stats})
    return {"labels": [model.label for model in columns], "rows": rows}


def _ablations(outcome: Outcome, report: Report, curves: Sequence[Curve]) -> dict[str, Any]:
    """The parts of that section; empty if it has none."""

    def rows(names: Sequence[str]) -> list[dict[str, str]]:
        return [
            {
                "label": model.label,
                "basis": model.basis,
                "mm": tables.pair(report, name, Alignment.MM),
                "normal": tables.pair(report, name, Alignment.SIZE_NORMALISED),
            }
            for name in names
            if (model := report.model(name)) is not None
        ]

    lambdas = any(report.model(name) is not None for name in LAMBDAS)
    calibrated = any(report.model(name) is not None for name in (FITTED_HELD_OUT, FITTED))
    parts = {
        "lambdas": rows((*LAMBDAS, "ccd-bsm")) if lambdas else [],
        "lambda_images": list(_of_one_cell(outcome, (*LAMBDAS, "ccd-bsm"))) if lambdas else [],
        "calibrated": rows(CALIBRATED) if calibrated else [],
        "steps": _by_strokes(report) if report.by_strokes else "",
        "curves": _curves(curves) if curves else "",
    }
    return parts if any(parts.values()) else {}


def provenance(session: Session) -> list[tuple[str, str]]:
    """Name and text of what is known of a recording."""
    header = session.header
    rows = [
        ("session", session.session_id),
        ("source", str(header.source)),
        ("recording", f"{session.recording}, sha256 {session.recording_sha256}"),
        ("recorded with", header.software),
        ("robot", f"{header.robot} {header.robot_firmware}".strip()),
        ("camera", f"{header.camera} {header.lens}".strip()),
        ("brush", session.brush),
        ("ink, paper", ", ".join(part for part in (header.ink, header.paper) if part)),
        ("protocol", header.protocol),
        ("origin", header.origin),
        ("licence", header.licence),
        ("calibration", _calibration(session)),
        ("brush fit", session.fit),
        ("strokes", _strokes(session)),
        ("zero touch", "" if session.collected is None else ", ".join(session.collected.touches)),
    ]
    return [(name, text) for name, text in rows if text]


def _strokes(session: Session) -> str:
    collected = session.collected
    if collected is None:
        return f"{session.strokes} captured, {session.compared} compared"
    planned = "" if collected.planned is None else f"{collected.planned} planned, "
    return (
        f"{planned}{collected.photographed} photographed, {len(collected.pressed_again)} of them pressed again, "
        f"{len(collected.left_out)} left out, {session.strokes} counted, {session.compared} compared"
    )


def _calibration(session: Session) -> str:
    scale = session.calibration
    if scale is None:
        return ""
    return (
        f"{scale.named}: pix2len {scale.mm_per_px:.5f} mm/px (95 % {scale.low:.5f} to {scale.high:.5f}), "
        f"board residual {scale.rms_px:.3f} px"
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
