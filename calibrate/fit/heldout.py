"""How well a fit predicts conditions that it has not seen, compared with the ceiling and with other models."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare import KEYS, MM_BINARY, Alignment, similarity
from brushloop.calibrate.fit.fit import Floats, fit_presses
from brushloop.calibrate.scores import Stat, statistics
from brushloop.calibrate.stats import CEILING, ceiling_values, pair_means
from brushloop.calibrate.work import Arrays, Scheduler, Store, key_of, threads
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress, Prior
from brushloop.model.presses import DepthTilt, Draw, Presses, image_of, refit_bezier
from brushloop.sessions.terminal import Progress, counted, unseen

FITTED, BEZIER, UNCALIBRATED = "CCD-BSM calibrated", "Bezier refitted", "CCD-BSM as published"
Images = NDArray[np.floating]
MAX_FOLDS = 15
"""Most folds: the paper's grid leaves out one condition at a time, a larger grid several."""
PER_CONDITION = 4
"""Presses of each other condition that a fit uses: the fourth improves predictions by up to 0.15 points of CSIM."""
MAX_STROKES = 60

Predicted = tuple[Floats, Mapping[str, Images]]
"""The ink of the presses of one condition, (n, rows, columns), and what each model predicts there without them."""


def leave_out(presses: Presses, conditions: Mapping[DepthTilt, Sequence[int]]) -> list[tuple[list[DepthTilt], Presses]]:
    """Conditions left out together, and the presses of all others that a fit uses; none if no press is left."""
    conditions = dict(sorted(conditions.items()))
    left_out: list[tuple[list[DepthTilt], Presses]] = []
    for fold in (list(conditions)[k::MAX_FOLDS] for k in range(min(len(conditions), MAX_FOLDS))):
        others = [press for at, group in conditions.items() if at not in fold for press in group[:PER_CONDITION]]
        if others:
            left_out.append((fold, presses.pick(others[:: -(-len(others) // MAX_STROKES)])))
    return left_out


@dataclass(frozen=True, slots=True)
class Refit:
    """A fit of the brush to some presses of a session."""

    presses: Presses
    prior: Prior | None = None
    start: Floats | None = None
    """Parameters (17,) of the fit to all presses, where the descent begins; None searches from the prior."""

    @property
    def key(self) -> str:
        """Key in the store of finished work."""
        prior = () if self.prior is None else (self.prior.mean, self.prior.precision)
        of, grid = self.presses, self.presses.grid
        numbers = of.radius_mm, of.length_mm, grid.x_mm, grid.y_mm, of.commands, of.ink
        return key_of("refit", *numbers, *prior, self.start)


def refit(job: Refit) -> Arrays:
    """The numbers of the fitted brush."""
    press = fit_presses(job.presses, prior=job.prior, start=job.start)
    return {"values": press.values, "across": press.across, "ends": press.ends}


def refits(
    jobs: Sequence[Refit], store: Store | None, scheduler: Scheduler, what: str = "", progress: Progress = unseen
) -> list[FittedPress]:
    """The fitted brush of each job; jobs that are not finished in the store run side by side."""
    keys = [job.key for job in jobs]
    unique = dict(zip(keys, jobs, strict=True))
    results = dict(counted(scheduler.finished(refit, unique.items(), store), what, len(unique), progress))
    brushes = ((job.presses.radius_mm, job.presses.length_mm) for job in jobs)
    return [FittedPress(*brush, **results[key]) for key, brush in zip(keys, brushes, strict=True)]


def leave_condition_out(
    presses: Presses,
    press: FittedPress,
    prior: Prior | None = None,
    progress: Progress = unseen,
    store: Store | None = None,
) -> tuple[list[Stat], dict[DepthTilt, Predicted]]:
    """Score each condition as predicted by fits to other conditions, and what was compared; empty for a single one.

    The fits descend from `press`, the fit to all conditions. `brushloop validate` uses the same fits, which the store
    keeps. Models without enough data are left out: the ceiling needs two strokes of a condition, a regressed Bezier two
    depths and two tilts among the others.
    """
    conditions = presses.conditions
    published = FittedPress(presses.radius_mm, presses.length_mm)
    left_out = leave_out(presses, conditions)
    jobs = [Refit(others, prior, press.values) for _, others in left_out]
    with threads(1) as scheduler:  # a fit holds Python's lock nearly all the time: two at once take half as long again
        brushes = refits(jobs, store, scheduler, "conditions left out in turn", progress)
    predicted: dict[DepthTilt, Predicted] = {}
    for (fold, others), refitted in zip(left_out, brushes, strict=True):
        outlines: dict[str, Draw] = {FITTED: refitted.outline, UNCALIBRATED: published.outline}
        if (of_others := refit_bezier(others)) is not None:
            outlines[BEZIER] = of_others
        for condition in fold:
            images: dict[str, Images] = {}
            for name, outline in outlines.items():
                with contextlib.suppress(DomainError):  # so light that the brush leaves no mark
                    images[name] = image_of(outline(*condition), presses.grid)
            predicted[condition] = presses.ink[conditions[condition]], images
    return held_out_scores(list(predicted.values()), (FITTED, BEZIER, UNCALIBRATED)), predicted


def held_out_scores(predicted: Sequence[Predicted], models: Sequence[str]) -> list[Stat]:
    """The statistics of the ceiling, then of these models, mm and binary; one without a score has none."""
    conditions = np.repeat(np.arange(len(predicted)), [len(ink) for ink, _ in predicted])
    percent = {name: np.full((len(conditions), len(KEYS), 2), np.nan) for name in (CEILING, *models)}
    for number, (ink, images) in enumerate(predicted):
        inks, rows = np.where(ink > 0.5, 1.0, 0.0), conditions == number
        pairs = pair_means(len(inks), lambda k, others, inks=inks: similarity(inks[k], inks[others], Alignment.MM))
        percent[CEILING][rows, MM_BINARY] = 100.0 * pairs
        for name, image in images.items():
            drawn = np.where(image > 0.5, 1.0, 0.0)
            percent[name][rows, MM_BINARY] = 100.0 * similarity(drawn, inks, Alignment.MM)
    ceiling = np.apply_along_axis(ceiling_values, 0, percent[CEILING], conditions)
    stats = statistics(CEILING, ceiling, conditions)
    return [*stats, *(stat for name in models for stat in statistics(name, percent[name], conditions, None, ceiling))]
