"""The HTML report of presses: one self-contained file. Every plot shows its source in the picture itself."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.artefact import FOLDER
from brushloop.calibrate.compare.place import KEYS, TABLE_3, Alignment, Image, Pixels, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.fit.brush import FOLDER as FITS
from brushloop.calibrate.presses import Press
from brushloop.calibrate.report import (
    BLUE,
    COLOURS,
    ORANGE,
    Axis,
    Marks,
    Panel,
    chart_uri,
    ink_uri,
    overlay_uri,
    recording_facts,
    render,
    source_note,
)
from brushloop.calibrate.scores import Stat
from brushloop.calibrate.stats import CEILING, Cell
from brushloop.calibrate.validate import findings
from brushloop.calibrate.validate.models import (
    BEZIER_REFITTED,
    FITTED_HELD_OUT,
    FittedSession,
    ModelInfo,
)
from brushloop.calibrate.validate.report import NORMAL, STRICT, Report, Session, TableRow, table_1, table_2, table_3
from brushloop.calibrate.validate.run import Outcome

CELL_COLUMNS = ("ccd-bsmg", "ccd-bsm", FITTED_HELD_OUT, BEZIER_REFITTED, CEILING)
GRAY_MM = KEYS.index((Alignment.MM, Tone.GRAY))
MAX_REFUSED = 200
ROWS = slice(32, 96)
"""Rows to show: the middle half of a field, as a press is at most half as thick as the field is high."""
MAX_POINTS = 200
MAX_SAMPLES, MAX_CELLS, EXTREMES = 15, 5, 6
MAX_CURVE_BYTES = 64 * 1024 * 1024


Curve = tuple[str, list[int], list[float]]
"""Name, steps and validation losses of a training."""


def read_curve(text: str) -> Curve:
    """Read `NAME=FOLDER`, a folder that `brushloop train` wrote. Raises `CalibrationError` if it holds no curve."""
    name, _, folder = text.partition("=")
    path = Path(folder) / "validation.csv"
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_CURVE_BYTES).decode())))
        return name, [int(row["step"]) for row in rows], [float(row["mse"]) for row in rows]
    except (KeyError, TypeError, ValueError):
        raise CalibrationError(str(path), "is not a table of validation losses (step, mse)") from None


def page_of(
    outcome: Outcome,
    report: Report,
    curves: Sequence[Curve],
    beside: Sequence[str],
    figures_13: Sequence[tuple[str, str]] = (),
    pages: Sequence[tuple[str, str]] = (),
) -> str:
    """The whole page. `beside` names the data files in its folder, `pages` is what `pages_beside` finds.

    `figures_13` are sessions of characters and their pictures as data URIs.
    """
    shown, names = report.model(report.shown), [session.session_id for session in report.sessions]
    best, worst = _extremes(outcome, report.shown)
    columns = [model for name in CELL_COLUMNS if (model := report.model(name)) is not None]
    return render(
        "presses.html.j2",
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
        plot=_distributions(outcome, report),
        keys=KEYS,
        cell_columns=columns,
        cells=[_cell(report, cell, columns) for cell in report.cells],
        samples=[_pictured(outcome, k, report.shown) for k in _first_of_cells(outcome, MAX_SAMPLES)],
        side=_side_by_side(outcome),
        shown=shown.label if shown is not None else "",
        best=[_pictured(outcome, k, report.shown) for k in best],
        worst=[_pictured(outcome, k, report.shown) for k in worst],
        steps=_by_strokes(report) if report.by_strokes else "",
        curves=_curves(curves) if curves else "",
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


def _extremes(outcome: Outcome, model: str) -> tuple[list[int], list[int]]:
    """Numbers of the best and of the worst presses of a model, from the outermost; none without a model."""
    if not model:
        return [], []
    csim = outcome.scores.of_key(model, STRICT)[:, 0]
    known = np.flatnonzero(np.isfinite(csim))
    order: list[int] = known[np.argsort(csim[known], kind="stable")].tolist()
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[::-1][:count], order[:count]


def _pictured(outcome: Outcome, k: int, model: str) -> dict[str, Any]:
    """A press with what the model predicts for it, their difference, and their scores: the paper's figures 7 and 8."""
    press, csim, ssim = outcome.scores.presses[k], np.nan, np.nan
    captured, drawn = _shown(press.images), outcome.predicted(press)
    images = {"captured": ink_uri(captured)}
    if model in drawn:
        predicted = _shown(drawn[model])
        images |= {"predicted": ink_uri(predicted), "difference": overlay_uri(captured, predicted)}
        csim, ssim = 100.0 * outcome.scores.of_key(model, STRICT)[k]
    return {"press": press, "images": images, "scored": bool(np.isfinite(csim)), "csim": csim, "ssim": ssim}


def _side_by_side(outcome: Outcome) -> dict[str, Any]:
    """Some captures next to the prediction of every model: the paper's figures 3, 10 and 11."""
    labels = {model.name: model.info.label for group in outcome.models.values() for model in group}
    lines: list[tuple[Press, list[str]]] = []
    for press in (outcome.scores.presses[k] for k in _first_of_cells(outcome, MAX_CELLS)):
        drawn = outcome.predicted(press)
        predictions = (ink_uri(_shown(drawn[name])) if name in drawn else "" for name in labels)
        lines.append((press, [ink_uri(_shown(press.images)), *predictions]))
    return {"labels": list(labels.values()), "lines": lines}


def _first_of_cells(outcome: Outcome, most: int) -> list[int]:
    """The first capture of each condition; with more than `most` of them, of evenly spaced ones."""
    first = [numbers[0] for numbers in outcome.scores.conditions().values()]
    count = min(len(first), most)
    return [first[n * (len(first) - 1) // max(count - 1, 1)] for n in range(count)]


def _shown(images: Pixels) -> Image:
    """The rows to show of the gray image on the millimetre field, of (len(KEYS), 128, 128)."""
    return np.asarray(images[GRAY_MM][ROWS] / 255.0, np.float32)


def _distributions(outcome: Outcome, report: Report) -> str:
    """CSIM of every stroke by model in both alignments, with the average and its interval."""
    models = [model for name in outcome.scores.models if (model := report.model(name)) is not None][::-1]
    panels: list[Panel] = []
    for key in (STRICT, NORMAL):
        rng = np.random.default_rng(0)  # jitter only, so that points do not hide each other
        marks: list[Marks] = []
        for place, model in enumerate(models):
            stat = report.stat(model.name, key)
            if stat is None:
                continue
            csim = 100.0 * outcome.scores.of_key(model.name, key)[:, 0]
            csim = csim[np.isfinite(csim)][:: max(1, -(-len(csim) // MAX_POINTS))]
            marks.append(Marks(csim, place + 0.14 * rng.uniform(-1, 1, len(csim)), dot_px=3.0))
            if stat.csim.avg_interval is not None:
                marks.append(Marks(stat.csim.avg_interval, [place] * 2, ORANGE, line_px=3.0))
            marks.append(Marks([stat.csim.avg] * 2, [place - 0.3, place + 0.3], ORANGE, line_px=3.0))
        labels = {float(place): model.label for place, model in enumerate(models)}
        panels.append(Panel(f"{key[0]}, binary", Axis("CSIM, %"), Axis(ticks=labels), marks))
    return chart_uri(panels, (1060, 120 + 32 * len(models)), report.label)


def _by_strokes(report: Report) -> str:
    """CSIM on presses that were not fitted, against the number of presses that were."""
    marks: list[Marks] = []
    for name, colour in (("CCD-BSM", ORANGE), ("Bézier", BLUE)):
        csim: dict[int, list[float]] = {}
        for step in report.by_strokes:
            if step.model == name:
                csim.setdefault(step.strokes, []).append(step.csim)
        counts = sorted(csim)
        means = [np.mean(csim[count]) for count in counts]
        marks.append(Marks(counts, means, colour, f"{name} fitted", dot_px=6.0, line_px=1.5))
    ticks = {float(step.strokes): str(step.strokes) for step in report.by_strokes}
    across, up = Axis("presses that were fitted", ticks, log=True), Axis("CSIM on all others, %")
    return chart_uri([Panel("mm, binary", across, up, marks)], (720, 340), report.label)


def _curves(curves: Sequence[Curve]) -> str:
    """Validation losses of trained generators: the paper's figures 9 and 12."""
    colours = itertools.cycle(COLOURS)
    marks = [
        Marks(steps, losses, colour, name, dot_px=4.0, line_px=1.5)
        for (name, steps, losses), colour in zip(curves, colours, strict=False)
    ]
    title, up = "networks trained on exact images of stroke models", Axis("validation loss (MSE)", log=True)
    return chart_uri([Panel(title, Axis("step"), up, marks)], (720, 340))


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
