"""Predict the ink of dragged strokes: fitted on some images of a session, or read from an artefact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.drags.artefact import DragArtefact, Kept, Stamps
from brushloop.calibrate.drags.fit import (
    INK_ABOVE,
    SPREAD_MM,
    DragFit,
    Residual,
    captured_distance,
    clipped,
    fit_drags,
    threshold,
)
from brushloop.calibrate.errors import CalibrationError
from brushloop.model.drag import DragModel, distances, ink, trails

if TYPE_CHECKING:
    from brushloop.calibrate.drags.captures import Drawn

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

BETWEEN_SESSIONS = 0.66
"""Share of a correction that is used in another session than the one it was learned in: the slope, through zero, of
what the lag misses there on the correction. It is .75 and .57 for two sessions of one brush (`bench drags`)."""
FIT_MM = 0.8
"""Scale of the images that the parameters are fitted to: finer ones do not change the fit."""
STAMP_SPREAD_MM = 1.5
STAMP_ABOVE = (0.22, 0.26, 0.3, 0.34, 0.38, 0.42)
"""Thresholds tried for circle stamps, of which the best on the training strokes is used. The errors of stamps vary more
than those of the lag, so their edge spread differs, too."""


@dataclass(frozen=True, slots=True)
class Predictor:
    """A drag model with its edge, its threshold and what it learned from its training strokes."""

    model: DragModel
    spread_mm: float = SPREAD_MM
    above: float = INK_ABOVE
    kept: Kept | None = None
    learned: tuple[Residual, DragModel] | None = None
    """The ridges over `kept`, and the model that they correct."""
    share: float = 1.0
    """Share of the correction that is used: 1 in the session that it was learned in, `BETWEEN_SESSIONS` in others."""

    def ink(self, drawn: Drawn, images: Indices) -> NDArray[np.bool_]:
        """The ink that these images should show, (n, len(y_mm), len(x_mm))."""
        return self.ink_both_ways(drawn, images)[0]

    def ink_both_ways(self, drawn: Drawn, images: Indices) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """The ink that these images should show, and the same without the correction, (n, len(y_mm), len(x_mm))."""
        away = self.distance(drawn, images)
        alone = self.is_ink(away)
        change = self.correction(drawn, images)
        return (alone if change is None else self.is_ink(clipped(away) + change)), alone

    def distance(self, drawn: Drawn, images: Indices) -> Floats:
        """Signed distances of the model's marks, (n, len(y_mm), len(x_mm)) mm, positive in ink."""
        paths, groups = chosen(drawn, images)
        nodes, starts = trails(paths, self.model.vector())
        return distances(nodes, starts, drawn.x_mm, drawn.y_mm, groups)

    def correction(self, drawn: Drawn, images: Indices) -> Floats | None:
        """What the ridge adds to these distances once they are clipped; None without a ridge, or for figures."""
        if self.kept is None or self.learned is None or drawn.commands is None:
            return None
        residual, model = self.learned
        base = self.kept.base(model, chosen(drawn, images)[0])
        change = residual.add(drawn.commands[images], base) - clipped(base)
        return self.share * self.kept.placed(change, drawn.x_mm, drawn.y_mm)

    def is_ink(self, away_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether a pixel at this signed distance counts as ink."""
        return ink(np.asarray(away_mm, np.float64), self.spread_mm) > self.above


@dataclass(frozen=True, slots=True)
class Learned:
    """Fits to one set of images."""

    fit: DragFit
    predictor: Predictor
    stamps: Predictor


def learn(drawn: Drawn, images: Indices) -> Learned:
    """Fit lag, correction, threshold and circle stamps to these images of a session."""
    paths, groups = chosen(drawn, images)
    fit = _fit(drawn, images, lag=True, spread_mm=SPREAD_MM)
    kept, learned, above = None, None, INK_ABOVE
    if drawn.commands is not None and len(images) > 1:
        seen = drawn.ink[images] > 0.5
        commands = drawn.commands[images]
        base = fit.distance(paths, drawn.x_mm, drawn.y_mm, groups=groups)
        above = threshold(commands, base, captured_distance(seen, drawn.mm_per_px))
        kept = Kept.of(commands, seen, drawn.x_mm, drawn.y_mm, fit.model)
        learned = kept.residual() if kept is not None else None
    stamps = _fit(drawn, images, lag=False, spread_mm=STAMP_SPREAD_MM)
    return Learned(fit, Predictor(fit.model, fit.spread_mm, above, kept, learned), _stamps(drawn, images, stamps))


def predictors(artefact: DragArtefact, where: str, recording_sha256: str) -> tuple[Predictor, Predictor | None]:
    """The predictor of an artefact for a recording, and that of its circle stamps if it has any.

    Raises `CalibrationError` for ink that cannot be read.
    """
    try:
        learned = artefact.kept.residual() if artefact.kept is not None else None
    except (ValueError, np.linalg.LinAlgError) as error:
        raise CalibrationError(where, f"kept: {error}") from None
    own = not artefact.prior and artefact.recording_sha256 == recording_sha256
    share = 1.0 if own else BETWEEN_SESSIONS
    ours = Predictor(artefact.model(), artefact.spread_mm, artefact.ink_above, artefact.kept, learned, share)
    stamps = artefact.stamps
    if stamps is None:
        return ours, None
    return ours, Predictor(DragModel.of(np.array(stamps.parameters)), stamps.spread_mm, stamps.ink_above)


def stamps_of(predictor: Predictor) -> Stamps:
    """Circle stamps as they go into an artefact."""
    vector = [float(value) for value in predictor.model.vector()]
    return Stamps(parameters=vector, spread_mm=predictor.spread_mm, ink_above=predictor.above)


def chosen(drawn: Drawn, images: Indices) -> tuple[list[Floats], Indices]:
    """The paths of these images, and where each image's begin."""
    each = [drawn.paths[drawn.groups[i] : drawn.groups[i + 1]] for i in images]
    return [path for one in each for path in one], np.cumsum([0, *(len(one) for one in each)])


def coarse_step(drawn: Drawn) -> int:
    """Number of pixels that make about `FIT_MM`."""
    return max(1, round(FIT_MM / drawn.mm_per_px))


def coarse(drawn: Drawn, images: Indices) -> tuple[NDArray[np.float32], Floats, Floats]:
    """Ink, x and y of these images at about `FIT_MM` a pixel."""
    step = coarse_step(drawn)
    return drawn.ink[images][:, ::step, ::step], drawn.x_mm[::step], drawn.y_mm[::step]


def _fit(drawn: Drawn, images: Indices, *, lag: bool, spread_mm: float) -> DragFit:
    paths, groups = chosen(drawn, images)
    target, x_mm, y_mm = coarse(drawn, images)
    weights = drawn.weights[images]
    return fit_drags(paths, target, x_mm, y_mm, lag=lag, spread_mm=spread_mm, groups=groups, weights=weights)


def _stamps(drawn: Drawn, images: Indices, fit: DragFit) -> Predictor:
    truth = drawn.ink[images] > 0.5
    each = [Predictor(fit.model, fit.spread_mm, above) for above in STAMP_ABOVE]
    away = each[0].distance(drawn, images)
    return max(each, key=lambda one: float(binary_scores(one.is_ink(away), truth)[:, 0].mean()))
