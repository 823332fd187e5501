"""The HTML report of presses: one self-contained file. Every figure shows its source in the picture itself.

The paper's figures 3, 7, 8, 10 and 11 are pictures of presses; scores and losses are charts.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.artefact import FOLDER
from brushloop.calibrate.compare import KEYS, TABLE_3, Key, shown
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.fit import FOLDER as FITS
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
    render,
    source_note,
)
from brushloop.calibrate.scores import MEASURES, Stat
from brushloop.calibrate.stats import CEILING, Cell, Floats
from brushloop.calibrate.validate import findings
from brushloop.calibrate.validate.run import BEZIER_REFITTED, FITTED_HELD_OUT, FittedSession, ModelInfo, Outcome
from brushloop.calibrate.validate.tables import NORMAL, STRICT, Report, Session, TableRow, table_1, table_2, table_3

CELL_COLUMNS = ("ccd-bsmg", "ccd-bsm", FITTED_HELD_OUT, BEZIER_REFITTED, CEILING)
MAX_REFUSED = 200
MAX_SAMPLES = 15
MAX_POINTS = 200
MAX_CELLS, EXTREMES = 5, 6
Curve = tuple[str, Floats, Floats]
"""Name, steps and validation losses of a training."""


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
    best_model, names = report.model(report.shown), [session.session_id for session in report.sessions]
    best, worst = extremes(outcome, report.shown)
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
        table_one=table_1(report),
        table_two=table_2(report),
        table_three=list(_table_three(report)),
        figures_13=figures_13,
        paper_three=list(TABLE_3.values()),
        plot=distributions(outcome, report),
        keys=KEYS,
        headline=list(findings.headline(report)),
        scores=[(key, _scores(report, key)) for key in KEYS],
        cell_columns=columns,
        cells=[_cell(report, cell, columns) for cell in report.cells],
        samples=[pictured(outcome, k, report.shown) for k in first_of_cells(outcome, MAX_SAMPLES)],
        side=side_by_side(outcome),
        shown=best_model.label if best_model is not None else "",
        best=[pictured(outcome, k, report.shown) for k in best],
        worst=[pictured(outcome, k, report.shown) for k in worst],
        steps=by_strokes(report) if report.by_strokes else "",
        curves=losses(curves) if curves else "",
        refused=report.refused[:MAX_REFUSED],
        more_refused=max(0, len(report.refused) - MAX_REFUSED),
        provenance=[(session, provenance(session)) for session in report.sessions],
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


def provenance(session: Session) -> tuple[tuple[str, str], ...]:
    """Name and text of what is known of the strokes of a recording."""
    collected, counts = session.collected, f"{session.strokes} captured, {session.compared} compared"
    if collected is not None:
        planned = "" if collected.planned is None else f"{collected.planned} planned, "
        counts = (
            f"{planned}{collected.photographed} photographed, {len(collected.pressed_again)} of them pressed again, "
            f"{len(collected.left_out)} left out, {session.strokes} counted, {session.compared} compared"
        )
    touches = "" if collected is None else ", ".join(collected.touches)
    return ("brush fit", session.fit), ("strokes", counts), ("zero touch", touches)


def read_curve(text: str) -> Curve:
    """Read `NAME=FOLDER`, a folder that `brushloop train` wrote. Raises `CalibrationError` if it holds no curve."""
    name, _, folder = text.partition("=")
    path = Path(folder) / "validation.csv"
    try:
        steps, mse = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2).T
        return name, steps, mse
    except (OSError, ValueError):
        raise CalibrationError(str(path), "is not a table of validation losses (step, mse)") from None


def extremes(outcome: Outcome, model: str) -> tuple[list[int], list[int]]:
    """Numbers of the best and of the worst presses of a model, from the outermost; none without a model."""
    if not model:
        return [], []
    csim = outcome.scores.of_key(model, STRICT)[:, 0]
    known = np.flatnonzero(np.isfinite(csim))
    order: list[int] = known[np.argsort(csim[known], kind="stable")].tolist()
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[::-1][:count], order[:count]


def pictured(outcome: Outcome, k: int, model: str) -> dict[str, Any]:
    """A press with what the model predicts for it, their difference, and their scores: the paper's figures 7 and 8."""
    press, csim, ssim = outcome.scores.presses[k], np.nan, np.nan
    captured, drawn = shown(press.images), outcome.predicted(press)
    images = {"captured": ink_uri(captured)}
    if model in drawn:
        predicted = shown(drawn[model])
        images |= {"predicted": ink_uri(predicted), "difference": overlay_uri(captured, predicted)}
        csim, ssim = 100.0 * outcome.scores.of_key(model, STRICT)[k]
    return {"press": press, "images": images, "scored": bool(np.isfinite(csim)), "csim": csim, "ssim": ssim}


def side_by_side(outcome: Outcome) -> dict[str, Any]:
    """Some captures next to the prediction of every model: the paper's figures 3, 10 and 11."""
    labels = {model.name: model.info.label for group in outcome.models.values() for model in group}
    lines: list[tuple[Press, list[str]]] = []
    for press in (outcome.scores.presses[k] for k in first_of_cells(outcome, MAX_CELLS)):
        drawn = outcome.predicted(press)
        predictions = (ink_uri(shown(drawn[name])) if name in drawn else "" for name in labels)
        lines.append((press, [ink_uri(shown(press.images)), *predictions]))
    return {"labels": list(labels.values()), "lines": lines}


def first_of_cells(outcome: Outcome, most: int) -> list[int]:
    """The first capture of each condition; with more than `most` of them, of evenly spaced ones."""
    first = [numbers[0] for numbers in outcome.scores.conditions().values()]
    count = min(len(first), most)
    return [first[n * (len(first) - 1) // max(count - 1, 1)] for n in range(count)]


def distributions(outcome: Outcome, report: Report) -> str:
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


def by_strokes(report: Report) -> str:
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


def losses(curves: Sequence[Curve]) -> str:
    """Validation losses of generators side by side: the paper's figure 9, also for the strokes of figure 12."""
    colours = itertools.cycle(COLOURS)
    marks = [
        Marks(steps, losses, colour, name, dot_px=4.0, line_px=1.5)
        for (name, steps, losses), colour in zip(curves, colours, strict=False)
    ]
    title, up = "networks trained on exact images of stroke models", Axis("validation loss (MSE)", log=True)
    return chart_uri([Panel(title, Axis("step"), up, marks)], (720, 340))
