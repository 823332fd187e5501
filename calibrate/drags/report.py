"""The report of drags: one self-contained HTML file, a CSV of the measurements, a terminal summary.

With a fit of drags, of this session or another, it also holds what the fit predicts of every stroke. Scores are CSIM
and IoU of ink as 0 or 1 at the commanded place; no shift is searched for.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from brushloop.calibrate.artefact import made_by, put_to_use
from brushloop.calibrate.commands import FitRequest
from brushloop.calibrate.drags import Drags, read_drags
from brushloop.calibrate.drags.fit import PREDICTED, DragArtefact, adapt_drags, fit_drags, model_of, predicted
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.report import BLUE, ORANGE, about, chart_uri, picture_grid, render, source_note, write_files
from brushloop.calibrate.stats import CEILING, ceiling_values, pair_means, student_95
from brushloop.model.drag import Floats, Indices
from brushloop.model.similarity import binary_scores, inked_window
from brushloop.sessions.disk import csv_text
from brushloop.sessions.terminal import Progress, unseen

MEASURED = "measured.csv"
MAX_THUMBNAILS = 60
MAX_WORST = 12


@dataclass(frozen=True, slots=True)
class DragValidation:
    """What was measured in a recording of drags, and what a fit predicts of those that can be predicted."""

    drags: Drags
    fit: DragArtefact | None
    predicted: NDArray[np.bool_]
    """(n, rows, columns) ink that the fit predicts of the placed strokes; like all that follows, empty without one."""
    fitted: NDArray[np.bool_]
    """(n,) whether the fit was fitted to a stroke."""
    scores: dict[str, Floats]
    """(n, 2) CSIM and IoU, from 0 to 1, by row of the report; no ceiling, but NaN, where no command was repeated."""

    @property
    def scored(self) -> Indices:
        """The strokes that the means are over: those that the fit has not seen, or all if it has seen all."""
        return np.flatnonzero(~self.fitted | self.fitted.all())

    def means(self) -> dict[str, dict[str, float]]:
        """Mean CSIM, mean IoU, standard deviation of CSIM and number of strokes by row of the report."""
        rows: dict[str, dict[str, float]] = {}
        for name, scores in self.scores.items():
            known = scores[self.scored[np.isfinite(scores[self.scored, 0])]]
            if len(known):
                csim, iou, csim_sd = np.round([*known.mean(axis=0), known[:, 0].std()], 6).tolist()
                rows[name] = {"csim": csim, "iou": iou, "csim_sd": csim_sd, "strokes": len(known)}
        return rows

    def to_json(self, fit: DragArtefact) -> str:
        """All scores as JSON, with where ink and fit come from."""
        header = self.drags.session.header
        contents = {
            "session_id": header.session_id,
            "source": str(header.source),
            "recording_sha256": self.drags.session.sha256,
            "fit": fit.digest,
            "fit_session": fit.session_id,
            "fit_source": fit.source,
            "prior": fit.prior,
            "mm_per_px": fit.mm_per_px,
            "depth_at_the_ends": self.drags.ends,
            "in_sample": bool(self.fitted.all()),
            "over_all": self.means(),
            "left_out": [{"stroke_id": name, "why": why} for name, why in self.drags.left_out],
            "strokes": [
                {
                    "stroke_id": drag.stroke.stroke_id,
                    "in_sample": bool(self.fitted[k]),
                    "scores": {
                        name: {"csim": round(float(each[k, 0]), 6), "iou": round(float(each[k, 1]), 6)}
                        for name, each in self.scores.items()
                        if np.isfinite(each[k, 0])
                    },
                }
                for k, drag in enumerate(self.drags.placed)
            ],
        }
        return json.dumps(contents, indent=1, ensure_ascii=False) + "\n"


def validate_drags(session: Path, fit: Path | None, progress: Progress = unseen) -> DragValidation:
    """Measure every stroke of a session, and predict those that a fit of drags can predict.

    Raises `CalibrationError`, also for a file that is no fit of drags.
    """
    artefact = None if fit is None else DragArtefact.read(fit)
    drags = read_drags(session, progress)
    if artefact is None:
        return DragValidation(drags, None, np.zeros(0, bool), np.zeros(0, bool), {})
    captured = drags.drawings.ink > 0.5
    rows = predicted(model_of(artefact.parameters), artefact.kept, drags, np.arange(len(captured)))
    scores = {name: binary_scores(ink, captured) for name, ink in rows.items()}
    scores[CEILING] = _ceiling(drags.conditions, captured)
    known = artefact.fitted_strokes if artefact.recording_sha256 == drags.session.sha256 else ()
    fitted = np.array([drag.stroke.stroke_id in known for drag in drags.placed])
    return DragValidation(drags, artefact, rows[PREDICTED], fitted, scores)


def _ceiling(conditions: NDArray[np.int64], truth: NDArray[np.bool_]) -> Floats:
    """(n, 2) `ceiling_values` of CSIM and IoU, from 0 to 1; NaN for a stroke whose command was not repeated."""
    pairs = np.full((len(truth), 2), np.nan)
    for number in np.unique(conditions):
        at = np.flatnonzero(conditions == number)
        pairs[at] = pair_means(len(at), lambda k, others, a=truth[at]: binary_scores(a[others], a[[k] * len(others)]))
    return 0.01 * np.apply_along_axis(ceiling_values, 0, 100.0 * pairs, conditions)


def write_drags(validation: DragValidation, folder: Path, command: str) -> Path:
    """Write `report.html` and `measured.csv` into `folder`, and with a fit `report.json`; returns the page's path.

    Raises OSError.
    """
    drags, header = validation.drags, validation.drags.session.header
    step = max(1, -(-len(drags.strokes) // MAX_THUMBNAILS))
    page = render(
        "drags.html.j2",
        **about(header),
        header=header,
        provenance=(("validated with", made_by()), ("command", command)),
        width=width_sentence(drags),
        plot=_plot(drags) if drags.strokes else "",
        thumbnails=drags.strokes[::step],
        validation=validation,
        worst=list(_worst(validation)) if validation.fit else (),
    )
    files = {MEASURED: drags_csv(drags), "report.html": page}
    if validation.fit is not None:
        files["report.json"] = validation.to_json(validation.fit)
    write_files(folder, files)
    return folder / "report.html"


def drags_csv(drags: Drags) -> str:
    """CSV of commanded and measured values, one row per stroke."""
    commanded = [
        drag.stroke.commanded
        | {name: value for name in ("depth_mm", "tilt_deg") if (value := getattr(drag.stroke, name)) is not None}
        for drag in drags.strokes
    ]
    names = sorted({name for values in commanded for name in values})
    sizes = ("length_mm", "width_mm", "mid_width_mm", "area_mm2")
    head = ["stroke_id", *(f"commanded_{name}" for name in names), *(f"measured_{size}" for size in sizes)]
    source, rows = str(drags.session.header.source), list[list[object]]()
    for drag, values in zip(drags.strokes, commanded, strict=True):
        measured = [f"{getattr(drag.measured, size):.3f}" for size in sizes]
        marked = [int(drag.cut), "; ".join(drag.flags), source]
        rows.append([drag.stroke.stroke_id, *(values.get(name, "") for name in names), *measured, *marked])
    return csv_text([*head, "cut", "flags", "source"], rows)


def _worst(validation: DragValidation) -> Iterator[tuple[str, Floats, NDArray[np.float32], NDArray[np.float32]]]:
    """The strokes with the lowest CSIM among those scored, the worst first: name, scores, and images of an overlay."""
    scores, drags = validation.scores[PREDICTED], validation.drags
    for k in validation.scored[scores[validation.scored, 0].argsort(kind="stable")][:MAX_WORST]:
        captured, drawn = drags.drawings.ink[k], validation.predicted[k]
        window = inked_window(drawn, captured > 0.5, 0)
        yield drags.placed[int(k)].stroke.stroke_id, scores[k], captured[window], drawn[window].astype(np.float32)


def width_sentence(drags: Drags) -> str:
    """The line through the widths of a session, and how well it is known."""
    line = _line(drags)
    if line is None:
        return "No line was fitted to width and depth: fewer than 3 strokes are whole, or all have one depth."
    count = len(drags.widths())
    reach = student_95(count - 2) * line.stderr
    return (
        f"Mid-stroke width grows by {line.slope:.3f} mm per mm of commanded depth (95 % {line.slope - reach:.3f} to "
        f"{line.slope + reach:.3f}) from {line.intercept:+.2f} mm at depth 0; r = {line.rvalue:.2f}, n = {count}."
    )


def _line(drags: Drags) -> Any:
    """The regression of width on depth; None with fewer than 3 strokes, or no spread in depth or width."""
    from scipy.stats import linregress  # slow to import

    widths = drags.widths()
    return linregress(*widths.T) if len(widths) >= 3 and np.ptp(widths, axis=0).all() else None


def _plot(drags: Drags) -> str:
    """Width against depth, with the fitted line."""
    depth_mm, width_mm = drags.widths().T
    figure, [[axis]] = picture_grid(1, 1, (7.2, 4.0), str(drags.session.header.source))
    axis.plot(depth_mm, width_mm, "o", color=BLUE, alpha=0.6, markersize=4)
    if (line := _line(drags)) is not None:
        ends = np.array([depth_mm.min(), depth_mm.max()])
        axis.plot(ends, line.slope * ends + line.intercept, color=ORANGE, linewidth=1.5)
    axis.set(xlabel="commanded depth, mm", ylabel="measured width at the middle, mm")
    return chart_uri(figure)


def summary(validation: DragValidation) -> Iterator[Table | str]:
    """What is printed about a session: lines and tables."""
    drags, header = validation.drags, validation.drags.session.header
    yield f"{header.session_id}: {source_note(header.source)}"
    yield f"{len(drags.strokes)} strokes measured: {MEASURED} has length, width and area beside the commanded values"
    yield width_sentence(drags)
    if means := validation.means():
        over = "from a fit to these strokes" if validation.fitted.all() else "from a fit to other strokes"
        table = Table("", "n", "CSIM", "sd", "IoU", title=f"averages, {over}, percent ({header.source})")
        for name, row in means.items():
            percent = (f"{100 * row[measure]:.2f}" for measure in ("csim", "csim_sd", "iou"))
            table.add_row(name, f"{row['strokes']:.0f}", *percent)
        yield table
    yield from (f"not fitted: {drag.stroke.stroke_id}: {'; '.join(drag.flags)}" for drag in drags.strokes if drag.flags)
    yield from (f"not used: {stroke_id}: {why}" for stroke_id, why in drags.refused)


def fit_session(request: FitRequest, progress: Progress = unseen) -> Written:
    """Fit the drags of a session, or adapt a known brush to them, and put the fit to use. Raises `CalibrationError`."""
    if request.strokes is not None and request.prior is None:
        raise CalibrationError("--strokes", "needs --prior, the fit that is adapted to these few strokes")
    before = None if request.prior is None else DragArtefact.read(request.prior)
    drags = read_drags(request.session, progress)
    if before is None:
        artefact = fit_drags(drags, progress)
    else:
        artefact = adapt_drags(drags, before, request.strokes or len(drags.placed))
    path = put_to_use(artefact, drags.session.recording.path.parent)
    return Written(path, (*fit_lines(drags, artefact), f"Fit: {path}"), drags.left_out)


def fit_lines(drags: Drags, artefact: DragArtefact) -> Iterator[Any]:
    """What is printed about a fit: lines and tables."""
    label, note = about(drags.session.header).values()
    yield f"{note}; {len(artefact.fitted_strokes)} dragged strokes"
    yield from (f"left out: {name}: {why}" for name, why in drags.left_out)
    yield f"depth at both ends: {drags.ends or 'the same as in the middle, because the table gives none for the ends'}"
    if artefact.prior:
        adapted = ", ".join(artefact.refitted)
        yield f"Adapted from the brush of {artefact.prior_session} (fit {artefact.prior}): {adapted}."
    table = Table("parameter", "fitted", "95 %", title=f"drag model, mm ({label})")
    for name, value in artefact.parameters.items():
        interval = "not determined" if value.low is None else f"{value.low:.3f} to {value.high:.3f}"
        if artefact.prior and name not in artefact.refitted:
            interval = "as before"
        table.add_row(name, f"{value.value:.3f}", interval)
    yield table
    if artefact.held_out:
        title = f"strokes left out of the fit, a fifth at a time, at the commanded place, percent ({label})"
        table = Table("model", "CSIM", "IoU", title=title)
        for name, (csim, iou) in artefact.held_out.items():
            table.add_row(name, f"{csim:.2f}", f"{iou:.2f}")
        yield table
    elif not artefact.prior:
        yield "There are fewer than five different strokes, too few to leave some out of the fit."
