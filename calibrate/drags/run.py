"""Fit bristle lag to a session of dragged strokes: parameters with intervals, held-out scores, and the artefact."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, model_validator

from calibrate.artefact import Artefact, FittedValue, put_to_use
from calibrate.drags.captures import Drawn
from calibrate.drags.fit import INK_ABOVE, SPREAD_MM, DragFit, bootstrap, chance, fit_drags
from calibrate.errors import CalibrationError
from model.drag import DragModel
from sessions.progress import Progress, counted, unseen

FOLDER = "dragfit"
SCHEMA_VERSION = 1
FOLDS = 5
LEAST = 3
"""Least number of images: fewer do not distinguish lag from drift."""
LAGGING, STAMPS = "bristle lag", "circle stamps"
Floats = NDArray[np.float64]


class DragScore(BaseModel):
    """Score of one model on images that it was not fitted to, ink as 0 or 1, at the commanded place."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    csim_percent: float
    iou_percent: float
    images: int


class DragArtefact(Artefact):
    """The fitted drag model on disk. Equal inputs give an equal file."""

    schema_version: int = SCHEMA_VERSION
    session_id: str
    source: str
    recording_sha256: str
    calibration: str
    """Digest of the calibration that the captures were rectified with; empty for an import."""
    software: str
    images: int
    strokes: int
    mm_per_px: float
    spread_mm: float
    """Variation of an edge from stroke to stroke (scale of the logistic)."""
    parameters: dict[str, FittedValue]
    condition: float
    """Condition number of the scaled normal equations: above about 1e4 the parameters cannot be distinguished."""
    held_out: dict[str, DragScore]
    """Scores by model; empty with too few images to leave any out."""

    def model(self) -> DragModel:
        """The fitted drag model."""
        return DragModel(**{name: value.value for name, value in self.parameters.items()})

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if set(self.parameters) != set(DragModel.names()):
            raise ValueError(f"parameters: expected {', '.join(DragModel.names())}")
        return self


@dataclass(frozen=True, slots=True)
class FittedDrags:
    """A fit of a session and all that is printed about it."""

    fit: DragFit
    artefact: DragArtefact


def fit_drawn(drawn: Drawn, progress: Progress = unseen) -> FittedDrags:
    """Fit all images, leave out each fifth of them in turn, and make the artefact.

    Raises `CalibrationError` for fewer than three images.
    """
    if len(drawn.ink) < LEAST:
        raise CalibrationError(
            drawn.header.session_id, f"{len(drawn.ink)} images of dragged strokes, at least {LEAST} are needed"
        )
    fit = _fit(drawn, np.arange(len(drawn.ink)), lag=True)
    low, high = np.quantile(bootstrap(fit), [0.025, 0.975], axis=0)
    values = zip(fit.free, fit.model.vector(), low, high, strict=True)
    artefact = DragArtefact(
        session_id=drawn.header.session_id,
        source=drawn.header.source,
        recording_sha256=drawn.recording_sha256,
        calibration=drawn.calibration.digest if drawn.calibration else "",
        software=f"brushloop {version('brushloop')}",
        images=len(drawn.ink),
        strokes=len(drawn.paths),
        mm_per_px=drawn.mm_per_px,
        spread_mm=fit.spread_mm,
        parameters={n: FittedValue(value=float(v), low=float(a), high=float(b)) for n, v, a, b in values},
        condition=fit.condition,
        held_out=_held_out(drawn, progress) if len(drawn.ink) >= FOLDS else {},
    )
    return FittedDrags(fit, artefact)


def save(fitted: FittedDrags, session: Path) -> Path:
    """Write the artefact into the session's folder and use it from now on."""
    return put_to_use(fitted.artefact, session, FOLDER)


def _chosen(drawn: Drawn, images: NDArray[np.int64]) -> tuple[list[Floats], NDArray[np.int64]]:
    each = [drawn.paths[drawn.groups[i] : drawn.groups[i + 1]] for i in images]
    return [path for one in each for path in one], np.cumsum([0, *(len(one) for one in each)])


def _fit(drawn: Drawn, images: NDArray[np.int64], *, lag: bool) -> DragFit:
    paths, groups = _chosen(drawn, images)
    return fit_drags(paths, drawn.ink[images], drawn.x_mm, drawn.y_mm, lag=lag, groups=groups)


def _held_out(drawn: Drawn, progress: Progress) -> dict[str, DragScore]:
    order = np.random.default_rng(0).permutation(len(drawn.ink))
    scores: dict[str, list[tuple[float, float]]] = {LAGGING: [], STAMPS: []}
    for k in counted(range(FOLDS), "fifths left out in turn", FOLDS, progress):
        left, others = order[k::FOLDS], np.sort(np.setdiff1d(order, order[k::FOLDS]))
        for name, lag in ((LAGGING, True), (STAMPS, False)):
            fit = _fit(drawn, others, lag=lag)
            paths, groups = _chosen(drawn, left)
            seen = chance(fit.distance(paths, drawn.x_mm, drawn.y_mm, groups=groups), SPREAD_MM) > INK_ABOVE
            scores[name] += [_score(a, b) for a, b in zip(seen, drawn.ink[left] > 0.5, strict=True)]
    return {
        name: DragScore(
            csim_percent=100.0 * float(np.mean([csim for csim, _ in each])),
            iou_percent=100.0 * float(np.mean([iou for _, iou in each])),
            images=len(each),
        )
        for name, each in scores.items()
    }


def _score(seen: NDArray[np.bool_], truth: NDArray[np.bool_]) -> tuple[float, float]:
    both = float(np.count_nonzero(seen & truth))
    norm = float(np.sqrt(np.count_nonzero(seen) * np.count_nonzero(truth)))
    union = float(np.count_nonzero(seen | truth))
    return (both / norm if norm else 0.0), (both / union if union else 0.0)
