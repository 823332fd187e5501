"""The next plan of characters, corrected by the deviation of the last one's ink.

A drag does not leave the same ink as presses along its path. The captures are nevertheless inverted as if they were
presses: the intended trajectory is refined until its image matches the mean of the captures. Point by point, the
command is then moved opposite to the difference from the intention in x, y and depth (iterative learning control with
the model as its learning filter; D. A. Bristow, M. Tharayil, A. G. Alleyne, IEEE Control Systems 26(3), 2006). Tilt and
heading do not change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.compare.field import Image
from calibrate.errors import CalibrationError
from calibrate.writing.compare import WritingComparison
from calibrate.writing.plan_files import FigureRecord, PlannedBy, PlanRecord, arrays, figure_record
from model.brush import Brush, DomainError
from model.characters.brush import Reach
from model.characters.refine import refine
from model.protocol import StrokeModel
from model.registry import UnknownModelError, stroke_model

Floats = NDArray[np.float64]
STEPS = 60
MOST_MM = 3.0
"""Largest correction of a coordinate in one round; more comes from ink that is unseen or of another stroke."""


@dataclass(frozen=True, slots=True)
class Lesson:
    """Root mean square of one character's correction, in mm."""

    name: str
    sideways_mm: float
    depth_mm: float


def learned(written: WritingComparison, gain: float = 0.8) -> tuple[PlanRecord, list[Lesson]]:
    """The next plan of the characters that were captured, and how far each was off. Raises `CalibrationError`."""
    plan = written.plan
    reach, model = reach_of(plan.planned_by), model_of(plan.planned_by)
    captured = {one.name: one.mean_ink() for one in written.characters}
    figures: list[FigureRecord] = []
    lessons: list[Lesson] = []
    for figure in plan.figures:
        if figure.name not in captured:
            raise CalibrationError(str(written.recording), f"shows no {figure.name!r}: nothing is learned for it")
        commanded, intended, lesson = _corrected(figure, captured[figure.name], model, reach, plan.cell_mm, gain)
        lessons.append(lesson)
        images = {"wanted": figure.wanted(), "simulated": figure.simulated()}
        figures.append(figure_record(figure.name, figure.source, commanded, intended, **images))
    return plan.model_copy(update={"figures": tuple(figures), "software": written.software}), lessons


def reach_of(by: PlannedBy) -> Reach:
    """The reach that a plan was made with."""
    return Reach(by.height_range_mm, by.tilt_range_deg, turn_deg_mm=by.turn_deg_mm)


def model_of(by: PlannedBy) -> StrokeModel:
    """The model that a plan was made with. Raises `CalibrationError` if it is no longer known."""
    try:
        return stroke_model(by.model, Brush(by.radius_mm, by.length_mm), math.pi if by.lam is None else by.lam)
    except (UnknownModelError, DomainError) as error:
        raise CalibrationError("plan.json", f"planned_by: {error}") from None


def _corrected(
    figure: FigureRecord, ink: Image, model: StrokeModel, reach: Reach, side_mm: float, gain: float
) -> tuple[list[Floats], list[Floats], Lesson]:
    intended, commanded = arrays(figure.intended), arrays(figure.commanded)
    seen = refine(model, intended, ink, side_mm, reach, STEPS).strokes
    next_commanded: list[Floats] = []
    next_intended: list[Floats] = []
    off = [smoothed(want[:, :3] - have[:, :3]) for want, have in zip(intended, seen, strict=True)]
    for command, want, move in zip(commanded, intended, off, strict=True):
        tried = command.copy()
        tried[:, :3] += np.clip(gain * move, -MOST_MM, MOST_MM)
        feasible = np.round(reach.within(tried, side_mm), 3)
        # The last column holds the number of each point that was kept.
        kept: Floats = reach.spaced(np.hstack((feasible, np.arange(len(tried), dtype=np.float64)[:, None])))
        next_commanded.append(kept[:, :5])
        next_intended.append(want[kept[:, 5].astype(np.int64)])
    every: Floats = np.concatenate(off) ** 2
    sideways_mm, depth_mm = math.sqrt(2.0 * float(every[:, :2].mean())), math.sqrt(float(every[:, 2].mean()))
    return next_commanded, next_intended, Lesson(figure.name, sideways_mm, depth_mm)


def smoothed(moves: Floats) -> Floats:
    """Average (N, 3) with their neighbours, weights 1 4 6 4 1: a deviation of a single point is noise."""
    for _ in range(2):
        padded = np.concatenate((moves[:1], moves, moves[-1:]))
        moves = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    return moves
