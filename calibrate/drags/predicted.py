"""Strokes of a session predicted by a fit of another: scores for each stroke and over all.

Scores are CSIM and IoU of ink as 0 or 1 at the commanded place; no shift is searched for.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.drags.artefact import DragArtefact
from brushloop.calibrate.drags.captures import Drawn, read_drags
from brushloop.calibrate.drags.predict import Predictor, predictors
from brushloop.calibrate.stats import CEILING, ceiling_values, pair_means
from brushloop.sessions.terminal import Progress, unseen

Floats = NDArray[np.float64]
OURS, LAG, STAMPS = "predicted", "bristle lag alone", "circle stamps"
PIECE = 32
"""Images predicted at a time, so that memory stays bounded."""


@dataclass(frozen=True, slots=True)
class PredictedStroke:
    """One stroke beside its predictions."""

    stroke_id: str
    scores: dict[str, tuple[float, float]]
    """CSIM and IoU by row of the report."""
    in_sample: bool
    """Whether the fit was fitted to this stroke."""
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Predictions:
    """Every usable stroke of a session, and the fit that predicted it."""

    artefact: DragArtefact
    strokes: tuple[PredictedStroke, ...]
    drawn: Drawn
    seen: NDArray[np.bool_]
    """(n, rows, columns) predicted ink."""
    corrected: bool = True
    """Whether the correction was used, as the strokes of the session that were seen decide."""

    @property
    def scored(self) -> tuple[PredictedStroke, ...]:
        """The strokes that the means are over: those that the fit has not seen, or all if it has seen all."""
        new = tuple(stroke for stroke in self.strokes if not stroke.in_sample)
        return new or self.strokes

    @property
    def in_sample(self) -> bool:
        """Whether the fit was fitted to every stroke."""
        return all(stroke.in_sample for stroke in self.strokes)

    def means(self) -> dict[str, tuple[float, float, float, int]]:
        """Mean CSIM, mean IoU, standard deviation of CSIM and number of strokes by row of the report."""
        found: dict[str, tuple[float, float, float, int]] = {}
        for name in (OURS, LAG, STAMPS, CEILING):
            each = np.array([stroke.scores[name] for stroke in self.scored if name in stroke.scores])
            if len(each):
                found[name] = (float(each[:, 0].mean()), float(each[:, 1].mean()), float(each[:, 0].std()), len(each))
        return found

    def worst(self, count: int) -> list[int]:
        """Positions of the strokes with the lowest CSIM among those scored, the worst first."""
        scored = {stroke.stroke_id for stroke in self.scored}
        at = [k for k, stroke in enumerate(self.strokes) if stroke.stroke_id in scored]
        return sorted(at, key=lambda k: self.strokes[k].scores[OURS][0])[:count]

    def to_json(self) -> str:
        """All scores as JSON, with where ink and fit come from."""
        header, fit = self.drawn.header, self.artefact
        table = {
            name: {"csim": round(csim, 6), "iou": round(iou, 6), "csim_sd": round(sd, 6), "strokes": n}
            for name, (csim, iou, sd, n) in self.means().items()
        }
        rows = [
            {
                "stroke_id": stroke.stroke_id,
                "in_sample": stroke.in_sample,
                "flags": list(stroke.flags),
                "scores": {n: {"csim": round(c, 6), "iou": round(i, 6)} for n, (c, i) in stroke.scores.items()},
            }
            for stroke in self.strokes
        ]
        said = {
            "session_id": header.session_id,
            "source": str(header.source),
            "recording_sha256": self.drawn.recording_sha256,
            "fit": fit.digest,
            "fit_session": fit.session_id,
            "fit_source": fit.source,
            "prior": fit.prior,
            "mm_per_px": fit.mm_per_px,
            "depth_at_the_ends": self.drawn.ends,
            "in_sample": self.in_sample,
            "over_all": table,
            "left_out": [{"stroke_id": name, "why": why} for name, why in self.drawn.refused],
            "strokes": rows,
        }
        return json.dumps(said, indent=1, ensure_ascii=False) + "\n"


def predict_session(
    session: Path, fit: Path, calibration: Path | None = None, progress: Progress = unseen
) -> Predictions:
    """Predict every usable stroke of a session. Raises `CalibrationError` for a file that is no fit of drags."""
    artefact = load_artefact(fit, DragArtefact)
    drawn = read_drags(session, artefact.mm_per_px, calibration, progress)
    ours, stamps = predictors(artefact, str(fit), drawn.recording_sha256)
    truth = drawn.ink > 0.5
    known = set(artefact.fitted_strokes) if artefact.recording_sha256 == drawn.recording_sha256 else set[str]()
    corrected, alone = _in_pieces(drawn, ours)
    fitted = np.array([name in known for name in drawn.stroke_ids])
    helps = not artefact.prior or correction_helps(corrected[fitted], alone[fitted], truth[fitted])
    seen = corrected if helps else alone
    rows = {OURS: binary_scores(seen, truth)}
    if ours.kept is not None and drawn.commands is not None:
        rows[LAG] = binary_scores(alone, truth)
    if stamps is not None:
        rows[STAMPS] = binary_scores(_in_pieces(drawn, stamps)[0], truth)
    ceiling = _ceiling(drawn, truth)
    strokes = [
        PredictedStroke(
            name,
            {row: (float(each[k, 0]), float(each[k, 1])) for row, each in rows.items()}
            | ({CEILING: ceiling[k]} if k in ceiling else {}),
            name in known,
            drawn.flags[k],
        )
        for k, name in enumerate(drawn.stroke_ids)
    ]
    return Predictions(artefact, tuple(strokes), drawn, seen, helps)


def correction_helps(corrected: NDArray[np.bool_], alone: NDArray[np.bool_], truth: NDArray[np.bool_]) -> bool:
    """Whether the strokes that were seen are predicted better with the correction; as usual if none was seen."""
    if not len(truth):
        return True
    with_it, without = (float(binary_scores(ink, truth)[:, 0].mean()) for ink in (corrected, alone))
    return with_it > without


def _in_pieces(drawn: Drawn, predictor: Predictor) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    count = len(drawn.ink)
    pieces = [predictor.ink_both_ways(drawn, np.arange(k, min(k + PIECE, count))) for k in range(0, count, PIECE)]
    return np.concatenate([seen for seen, _ in pieces]), np.concatenate([alone for _, alone in pieces])


def _ceiling(drawn: Drawn, truth: NDArray[np.bool_]) -> dict[int, tuple[float, float]]:
    """`ceiling_values` of CSIM and IoU, from 0 to 1, of each stroke whose command was repeated."""
    if drawn.commands is None:
        return {}
    _, command = np.unique(drawn.commands, axis=0, return_inverse=True)
    command = command.reshape(-1)
    pairs = np.full((len(truth), 2), np.nan)
    for number in range(int(command.max()) + 1):
        at = np.flatnonzero(command == number)
        pairs[at] = _pairs(truth[at])
    found = 0.01 * np.apply_along_axis(ceiling_values, 0, 100.0 * pairs, command)
    return {k: (csim, iou) for k, (csim, iou) in enumerate(found.tolist()) if np.isfinite(csim)}


def _pairs(alike: NDArray[np.bool_]) -> Floats:
    return pair_means(len(alike), lambda k, others: binary_scores(alike[others], alike[[k] * len(others)]))
