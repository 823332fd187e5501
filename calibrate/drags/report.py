"""The report of drags: one self-contained HTML file, a CSV of the measurements, a terminal summary.

With a fit of drags, of this session or another, it also holds what the fit predicts of every stroke. Scores are CSIM
and IoU of ink as 0 or 1 at the commanded place; no shift is searched for.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from brushloop.calibrate.artefact import load_artefact, made_by
from brushloop.calibrate.drags.brush import STAMPS, DragArtefact, correction_helps
from brushloop.calibrate.drags.captures import LENGTH_NAME, DragResults, Drawn, read_drags
from brushloop.calibrate.report import (
    BLUE,
    ORANGE,
    dress,
    image_uri,
    overlay_uri,
    plot,
    plot_uri,
    recording_facts,
    render,
    source_label,
    source_note,
    write_files,
)
from brushloop.calibrate.stats import CEILING, ceiling_values, pair_means
from brushloop.model.drag import Floats
from brushloop.model.similarity import binary_scores
from brushloop.sessions.disk import csv_text
from brushloop.sessions.records import Header
from brushloop.sessions.terminal import Progress, unseen

MEASURED = "measured.csv"
MAX_THUMBNAILS = 60
MAX_WORST = 12
OURS, LAG = "predicted", "bristle lag alone"
ENDS_UNKNOWN = (
    "The table gives no depth at the ends (depth_ends_mm, or z_frac_ends beside z_frac_mid): the depth is taken as "
    "constant."
)
LIMITS = (
    "These strokes travel along the paper, and the radius and bundle length of their brush are not known. CCD-BSM "
    "describes one vertical press, so its length, outline, CSIM and SSIM cannot be compared with these strokes and "
    "are not given. What can be compared is how the width grows with depth."
)


@dataclass(frozen=True, slots=True)
class Predictions:
    """Every usable stroke of a session beside its predictions, and the fit that predicted it."""

    artefact: DragArtefact
    drawn: Drawn
    scores: dict[str, Floats]
    """(n, 2) CSIM and IoU by row of the report; NaN where a stroke has none."""
    seen: NDArray[np.bool_]
    """(n, rows, columns) predicted ink."""
    fitted: NDArray[np.bool_]
    """(n,) whether the fit was fitted to the stroke."""
    corrected: bool = True
    """Whether the correction was used, as the strokes of the session that were seen decide."""

    @property
    def scored(self) -> NDArray[np.int64]:
        """The strokes that the means are over: those that the fit has not seen, or all if it has seen all."""
        return np.flatnonzero(~self.fitted | self.fitted.all())

    def means(self) -> dict[str, tuple[float, float, float, int]]:
        """Mean CSIM, mean IoU, standard deviation of CSIM and number of strokes by row of the report."""
        found: dict[str, tuple[float, float, float, int]] = {}
        for name, scores in self.scores.items():
            each = scores[self.scored]
            each = each[np.isfinite(each[:, 0])]
            if len(each):
                found[name] = (float(each[:, 0].mean()), float(each[:, 1].mean()), float(each[:, 0].std()), len(each))
        return found

    def rows(self) -> Iterator[tuple[str, float, float, bool, str]]:
        """Stroke, CSIM, IoU, whether it was fitted, and its flags."""
        for k, name in enumerate(self.drawn.stroke_ids):
            csim, iou = self.scores[OURS][k].tolist()
            yield name, csim, iou, bool(self.fitted[k]), "; ".join(self.drawn.flags[k])

    def worst(self) -> list[int]:
        """Positions of the strokes with the lowest CSIM among those scored, the worst first."""
        return sorted(self.scored.tolist(), key=lambda k: self.scores[OURS][k, 0])[:MAX_WORST]

    def to_json(self) -> str:
        """All scores as JSON, with where ink and fit come from."""
        header, fit, drawn = self.drawn.header, self.artefact, self.drawn
        contents = {
            "session_id": header.session_id,
            "source": str(header.source),
            "recording_sha256": drawn.recording_sha256,
            "fit": fit.digest,
            "fit_session": fit.session_id,
            "fit_source": fit.source,
            "prior": fit.prior,
            "mm_per_px": fit.mm_per_px,
            "depth_at_the_ends": drawn.ends,
            "in_sample": bool(self.fitted.all()),
            "over_all": {
                name: {"csim": round(csim, 6), "iou": round(iou, 6), "csim_sd": round(sd, 6), "strokes": n}
                for name, (csim, iou, sd, n) in self.means().items()
            },
            "left_out": [{"stroke_id": name, "why": why} for name, why in drawn.refused],
            "strokes": [
                {
                    "stroke_id": name,
                    "in_sample": bool(self.fitted[k]),
                    "flags": list(drawn.flags[k]),
                    "scores": {
                        row: {"csim": round(float(scores[k, 0]), 6), "iou": round(float(scores[k, 1]), 6)}
                        for row, scores in self.scores.items()
                        if np.isfinite(scores[k, 0])
                    },
                }
                for k, name in enumerate(drawn.stroke_ids)
            ],
        }
        return json.dumps(contents, indent=1, ensure_ascii=False) + "\n"


def predict_session(
    session: Path, fit: Path, calibration: Path | None = None, progress: Progress = unseen
) -> Predictions:
    """Predict every usable stroke of a session. Raises `CalibrationError` for a file that is no fit of drags."""
    artefact = load_artefact(fit, DragArtefact)
    drawn = read_drags(session, artefact.mm_per_px, calibration, progress)
    predictor, every = artefact.predictor(str(fit), drawn.recording_sha256), np.arange(len(drawn.stroke_ids))
    truth = drawn.drawings.ink > 0.5
    own = artefact.recording_sha256 == drawn.recording_sha256
    fitted = np.array([own and name in artefact.fitted_strokes for name in drawn.stroke_ids])
    corrected, alone = predictor.ink(drawn, every)
    helps = not artefact.prior or correction_helps(corrected[fitted], alone[fitted], truth[fitted])
    seen = corrected if helps else alone
    scores = {OURS: binary_scores(seen, truth)}
    if predictor.correction is not None and drawn.commands is not None:
        scores[LAG] = binary_scores(alone, truth)
    scores[STAMPS] = binary_scores(artefact.stamp_predictor().ink(drawn, every)[0], truth)
    if drawn.commands is not None:
        scores[CEILING] = _ceiling(drawn.conditions, truth)
    return Predictions(artefact, drawn, scores, seen, fitted, helps)


def _ceiling(conditions: NDArray[np.int64], truth: NDArray[np.bool_]) -> Floats:
    """(n, 2) `ceiling_values` of CSIM and IoU, from 0 to 1; NaN for a stroke whose command was not repeated."""
    pairs = np.full((len(truth), 2), np.nan)
    for number in np.unique(conditions):
        at = np.flatnonzero(conditions == number)
        alike = truth[at]
        pairs[at] = pair_means(len(at), lambda k, others, a=alike: binary_scores(a[others], a[[k] * len(others)]))
    return 0.01 * np.apply_along_axis(ceiling_values, 0, 100.0 * pairs, conditions)


@dataclass(frozen=True, slots=True)
class DragValidation:
    """A recording of drags, and what was measured in it."""

    header: Header
    recording: Path
    recording_sha256: str
    results: DragResults
    predictions: Predictions | None = None
    """With a fit of drags: what it predicts of this session."""


def write_drags(validation: DragValidation, folder: Path, command: str) -> Path:
    """Write `report.html` and `measured.csv` into `folder`; returns the report's path. Raises OSError."""
    results = validation.results
    recording, made = validation.recording, [("validated with", made_by()), ("command", command)]
    step = max(1, -(-len(results.strokes) // MAX_THUMBNAILS))
    page = render(
        "drags.html.j2",
        header=validation.header,
        note=source_note(validation.header.source, validation.header.brush),
        refused=results.refused,
        provenance=[*recording_facts(validation.header, recording.name, validation.recording_sha256, None), *made],
        strokes=len(results.strokes),
        limits=LIMITS,
        sentences=list(fit_sentences(results)),
        plot=_plot(results, str(validation.header.source)) if results.strokes else "",
        drags=results.strokes,
        names=sorted({name for drag in results.strokes for name in drag.commanded}),
        thumbnails=[(d.stroke_id, image_uri(d.thumbnail)) for d in results.strokes[::step]],
        cut=[d.stroke_id for d in results.strokes if d.cut],
        flagged=[(d.stroke_id, "; ".join(d.flags)) for d in results.strokes if d.flags],
        predictions=validation.predictions,
        predicted_by=list(prediction_sentences(validation.predictions)) if validation.predictions else [],
        worst=list(_worst(validation.predictions)) if validation.predictions else [],
    )
    files = {MEASURED: drags_csv(results, validation.header.source), "report.html": page}
    if validation.predictions is not None:
        files["report.json"] = validation.predictions.to_json()
    write_files(folder, files)
    return folder / "report.html"


def drags_csv(results: DragResults, source: str) -> str:
    """CSV of commanded and measured values, one row per stroke."""
    names = sorted({name for drag in results.strokes for name in drag.commanded})
    sizes = ["measured_length_mm", "measured_width_mm", "measured_mid_width_mm", "measured_area_mm2"]
    head = ["stroke_id", *(f"commanded_{name}" for name in names), *sizes, "cut", "flags", "source"]
    rows: list[list[object]] = []
    for drag in results.strokes:
        m = drag.measured
        measured = [f"{v:.3f}" for v in (m.length_mm, m.width_mm, m.mid_width_mm, m.area_mm2)]
        commanded = [drag.commanded.get(name, "") for name in names]
        rows.append([drag.stroke_id, *commanded, *measured, int(drag.cut), "; ".join(drag.flags), source])
    return csv_text(head, rows)


def prediction_sentences(predictions: Predictions) -> Iterator[str]:
    """Sentences on what predicted these strokes, and over which strokes the scores are."""
    fit, header = predictions.artefact, predictions.drawn.header
    adapted = f", adapted to {fit.images} strokes of {fit.session_id}" if fit.prior else ""
    origin = fit.prior_session if fit.prior else f"{fit.session_id}, {fit.source}"
    yield (
        f"{len(predictions.scored)} strokes ({header.source}) predicted by the fit {fit.digest} of {origin}{adapted}; "
        f"ink as 0 or 1 at the commanded place, {fit.mm_per_px:g} mm per pixel, no shift."
    )
    if not predictions.corrected:
        yield "The correction of the other session is left out: seen strokes are predicted better without it."
    if predictions.fitted.all():
        yield "In sample: the fit was fitted to every one of these strokes."
    elif predictions.fitted.any():
        yield f"The means leave out {predictions.fitted.sum()} strokes that the fit was fitted to."
    if CEILING not in predictions.means():
        yield "No command was repeated, so the ceiling (the score of a perfect model) is not known."
    if predictions.drawn.commands is not None:
        yield ends_sentence(predictions.drawn.ends)


def _worst(predictions: Predictions) -> Iterator[tuple[str, float, float, str]]:
    """Name, CSIM, IoU and overlay of the worst predicted strokes."""
    for k in predictions.worst():
        seen, ink = predictions.seen[k], predictions.drawn.drawings.ink[k]
        both = seen | (ink > 0.5)
        rows, columns = np.flatnonzero(both.any(axis=1)), np.flatnonzero(both.any(axis=0))
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        csim, iou = predictions.scores[OURS][k].tolist()
        uri = overlay_uri(ink[window].astype(np.float64), seen[window].astype(np.float64))
        yield predictions.drawn.stroke_ids[k], csim, iou, uri


def fit_sentences(results: DragResults) -> Iterator[str]:
    """Sentences on the fits of an imported session, and how they relate to CCD-BSM."""
    width, length = results.width_on_depth, results.length_on_commanded
    if width is None:
        yield "Width against depth: no fit (fewer than 3 whole strokes, or one depth only)."
    else:
        low, high = width.interval
        yield (
            f"Width at the middle against commanded depth: {width.slope:.3f} mm/mm (95 % {low:.3f} to {high:.3f}), "
            f"{width.intercept:+.2f} mm at depth 0, r = {width.r:.2f}, n = {width.n}."
        )
        if low <= 0.0:
            yield "The slope's interval reaches 0: these strokes do not show how the brush opens with depth."
        else:
            ratio = width.slope / (2.0 * math.pi)
            yield (
                "CCD-BSM opens linearly with depth from zero, 2 λ R/L per mm. With λ = π this slope would be that of a "
                f"brush with R/L = {ratio:.4f} (the paper's brush: 6/48 = {6 / 48:.4f}); a width at depth 0 is an "
                "error of the zero touch, or ink that spreads, which CCD-BSM does not describe."
            )
    if length is not None:
        yield (
            f"Measured length against commanded length: slope {length.slope:.3f}, {length.intercept:+.2f} mm, "
            f"r = {length.r:.2f}, n = {length.n}."
        )


def _plot(results: DragResults, source: str) -> str:
    """Width against depth and length against commanded length, with the fitted lines."""
    figure, axes = plot(1, 2, (10.0, 3.4))
    figure.suptitle(source)
    whole = [drag for drag in results.strokes if not drag.cut]
    widths = [(drag.depth_mm, drag.measured.mid_width_mm) for drag in whole]
    lengths = [(drag.commanded.get(LENGTH_NAME), drag.measured.length_mm) for drag in whole]
    for axis, points, line, x_title, y_title in (
        (axes[0], widths, results.width_on_depth, "commanded depth, mm", "measured width at the middle, mm"),
        (axes[1], lengths, results.length_on_commanded, "commanded length, mm", "measured length, mm"),
    ):
        known = [(x, y) for x, y in points if x is not None]
        axis.plot([x for x, _ in known], [y for _, y in known], ".", ms=5, alpha=0.6, color=BLUE)
        if line is not None:
            ends = np.array([min(known)[0], max(known)[0]])
            axis.plot(ends, line.slope * ends + line.intercept, color=ORANGE, lw=1.5)
        dress(axis, "", x_title, y_title)
    return plot_uri(figure)


def summary(validation: DragValidation) -> Iterator[Table | str]:
    """What is printed about a session: lines and tables."""
    results = validation.results
    yield f"{validation.header.session_id}: {source_note(validation.header.source)}"
    yield f"{len(results.strokes)} strokes measured: {MEASURED} has length, width and area beside what was commanded"
    yield from fit_sentences(results)
    if validation.predictions is not None:
        yield from prediction_sentences(validation.predictions)
        yield from _predicted(validation.predictions)
    for drag in results.strokes:
        if drag.flags:
            yield f"counts less: {drag.stroke_id}: {'; '.join(drag.flags)}"
    for stroke_id, why in results.refused:
        yield f"not used: {stroke_id}: {why}"


def _predicted(predictions: Predictions) -> Iterator[Table]:
    out = Table("", "n", "CSIM", "sd", "IoU", title=f"over all, percent ({predictions.drawn.header.source})")
    for name, (csim, iou, sd, count) in predictions.means().items():
        out.add_row(name, str(count), f"{100 * csim:.2f}", f"{100 * sd:.2f}", f"{100 * iou:.2f}")
    yield out
    out = Table("worst", "CSIM", "IoU", "flags", title="predicted worst, percent")
    rows = list(predictions.rows())
    for name, csim, iou, _, flags in (rows[k] for k in predictions.worst()):
        out.add_row(name, f"{100 * csim:.2f}", f"{100 * iou:.2f}", flags)
    yield out


def fit_lines(drawn: Drawn, artefact: DragArtefact) -> Iterator[object]:
    """What is printed about a fit: lines and tables."""
    label = source_label(drawn.header.source, [drawn.header.brush])
    yield (
        f"{source_note(drawn.header.source, drawn.header.brush)}; "
        f"{artefact.strokes} dragged strokes in {artefact.images} images"
    )
    yield from (f"left out: {name}: {why}" for name, why in drawn.refused)
    each = zip(drawn.stroke_ids, drawn.flags, strict=True)
    yield from (f"counts less: {name}: {'; '.join(flags)}" for name, flags in each if flags)
    if drawn.commands is not None:
        yield ends_sentence(drawn.ends)
    if artefact.prior:
        adapted = ", ".join(artefact.refitted)
        yield f"The brush of {artefact.prior_session} (fit {artefact.prior}), with these adapted: {adapted}."
    table = Table("parameter", "fitted", "95 %", title=f"drag model, mm ({label})")
    for name, found in artefact.parameters.items():
        interval = "not determined" if found.low is None else f"{found.low:.3f} to {found.high:.3f}"
        if artefact.prior and name not in artefact.refitted:
            interval = "as before"
        table.add_row(name, f"{found.value:.3f}", interval)
    yield table
    if artefact.kept is not None:
        yield f"A pixel is ink above a probability of {artefact.ink_above:g}, chosen by the training strokes."
    if artefact.held_out:
        title = f"a fifth left out in turn, where the command put it, percent ({label})"
        table = Table("model", "n", "CSIM", "IoU", title=title)
        for name, score in artefact.held_out.items():
            table.add_row(name, str(score.images), f"{score.csim_percent:.2f}", f"{score.iou_percent:.2f}")
        yield table
    elif not artefact.prior:
        yield "Fewer than five images: too few to leave some out."


def ends_sentence(ends: str) -> str:
    """Where the depth at both ends of a stroke comes from."""
    return f"The depth at both ends is that of the column {ends}." if ends else ENDS_UNKNOWN
