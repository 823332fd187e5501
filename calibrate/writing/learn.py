"""The next plan of characters, from what the ink of the last one showed.

Every round does three things. The footprint of the brush is fitted again to the captured characters, then to each of
their strokes. What these footprints still miss is measured phase by phase: the distance by which the edge of the ink
lies off the predicted edge. Then the points are moved until prediction and miss together give the wanted image, near
where they are, since the miss was measured there. This is iterative learning control with the drawing model as its
learning filter (D. A. Bristow, M. Tharayil, A. G. Alleyne, IEEE Control Systems 26(3), 2006), applied to the picture
of the ink as by Mueller et al., IROS 2013.

A character whose last round was no better than the best one goes back to the best and is settled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import Image, Tone
from brushloop.calibrate.drags.fit import captured_distance
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing.compare import WritingComparison, as_ink
from brushloop.calibrate.writing.plan_files import as_points, encoded, ways_of
from brushloop.calibrate.writing.plan_record import FigureRecord, PlannedBy, PlanRecord, Round, arrays
from brushloop.calibrate.writing.scores import HEADLINE, Character, compare_ink
from brushloop.model.characters.brush import Reach
from brushloop.model.characters.lead import LATER_SPREADS_MM, covered, drawn, lead
from brushloop.model.characters.phases import Phase, phase_map
from brushloop.model.characters.plan import grid, without_tilt
from brushloop.model.footprint import NAMES, Footprint, fit_each, fit_footprint

Floats = NDArray[np.float64]
MOST_MM = 1.5
"""Largest miss that is corrected in one round; more comes from ink that is unseen or of another stroke."""
NEAR_MM = 4.0
"""Distance from the captured edge within which a miss is measured."""
SMOOTH_PX = 0.7
HELD = 0.02
"""Cost of moving the points, see `lead`."""
FINER = 4
"""Mean ink is enlarged by this before its edge is measured, as the edge lies between pixels."""
LEAST_GAIN_PERCENT = 0.2
"""A round that gains less CSIM than this has not helped: two writings of one plan differ by about as much."""
WORSE = 0.5
"""Factor on the correction in each phase that became worse."""


@dataclass(frozen=True, slots=True)
class Lesson:
    """What a round found for one character."""

    name: str
    found: Round
    settled: bool


def learned(written: WritingComparison, gain: float = 0.7) -> tuple[PlanRecord, list[Lesson]]:
    """The next plan of the characters that were captured, and what was found. Raises `CalibrationError`."""
    plan = written.plan
    writings = {one.name: one for one in written.characters}
    captured = {name: one.mean_ink() for name, one in writings.items()}
    for figure in plan.figures:
        if figure.name not in captured:
            raise CalibrationError(str(written.recording), f"shows no {figure.name!r}: nothing is learned for it")
    footprint = _refitted(plan, captured)
    reach = reach_of(plan.planned_by)
    figures: list[FigureRecord] = []
    lessons: list[Lesson] = []
    for figure in plan.figures:
        found = round_of(figure, writings[figure.name], plan.cell_mm)
        after = _after(figure, found)
        if not after.settled:
            after = _corrected(after, captured[figure.name], footprint, reach, plan.cell_mm, gain)
        figures.append(after)
        lessons.append(Lesson(figure.name, found, after.settled))
    by = plan.planned_by.model_copy(update={"footprint": footprint.values})
    made = plan.model_copy(update={"planned_by": by, "figures": tuple(figures), "software": written.software})
    return made, lessons


def reach_of(by: PlannedBy) -> Reach:
    """The reach that a plan was made with."""
    return Reach(by.depth_range_mm, by.tilt_range_deg, turn_deg_mm=by.turn_deg_mm)


def _refitted(plan: PlanRecord, captured: dict[str, Image]) -> Footprint:
    """The footprint that fits the captured characters, from that of the plan where it has one."""
    known = plan.planned_by.footprint
    strokes = [[without_tilt(points) for points in arrays(figure.commanded)] for figure in plan.figures]
    groups = np.cumsum([0, *(len(one) for one in strokes)])
    ink = np.stack([captured[figure.name] for figure in plan.figures])
    x_mm, y_mm = grid(plan.cell_mm, ink.shape[1])
    # a plan of an earlier version holds the values of another model of the footprint: the fit begins afresh
    start = None if known is None or len(known) != len(NAMES) else Footprint(known)
    return fit_footprint([path for one in strokes for path in one], groups, ink, x_mm, y_mm, start)


def _after(figure: FigureRecord, found: Round) -> FigureRecord:
    """The figure with its round added, back at its best; settled if the round has not helped."""
    before = max((one.csim_percent for one in figure.rounds), default=float("-inf"))
    best = figure.commanded if found.csim_percent > before or not figure.best else figure.best
    rounds = (*figure.rounds, found)
    settled = figure.settled or not _helped(rounds)
    update = {"rounds": rounds, "best": best, "settled": settled, "commanded": best, "intended": best}
    return figure.model_copy(update=update)


def _helped(rounds: Sequence[Round]) -> bool:
    """Whether the last round was better than all before."""
    *before, last = (one.csim_percent for one in rounds)
    return last >= max(before, default=float("-inf")) + LEAST_GAIN_PERCENT


def _corrected(
    figure: FigureRecord, ink: Image, footprint: Footprint, reach: Reach, side_mm: float, gain: float
) -> FigureRecord:
    commanded = arrays(figure.commanded)
    size_px = len(ink)
    paths, groups = [without_tilt(points) for points in commanded], np.array([0, len(commanded)])
    footprints = fit_each(paths, groups, ink[None], *grid(side_mm, size_px), footprint)
    miss = missed(ink, drawn(footprints, commanded, side_mm, size_px), side_mm)
    miss *= gain * _trust(figure, side_mm, size_px)
    moved = lead(
        footprints,
        commanded,
        figure.wanted(),
        side_mm,
        reach,
        added_mm=miss,
        spreads_mm=LATER_SPREADS_MM,
        held=HELD,
    )
    simulated = covered(drawn(footprints, moved, side_mm, size_px) + miss, side_mm)
    points = as_points(moved)
    return figure.model_copy(update={"commanded": points, "intended": points, "simulated_png": encoded(simulated)})


def missed(ink: Image, predicted_mm: Floats, side_mm: float) -> Floats:
    """By how much the captured edge lies outside the predicted one, (N, N) mm, negative where it lies inside."""
    size_px = len(ink)
    finer = cv2.resize(ink, (FINER * size_px, FINER * size_px), interpolation=cv2.INTER_CUBIC) > 0.5
    if not finer.any():
        return np.zeros(ink.shape)
    seen = captured_distance([finer], side_mm / (FINER * size_px))[0]
    seen_mm = np.asarray(cv2.resize(seen, (size_px, size_px), interpolation=cv2.INTER_AREA), np.float64)
    off = np.clip(seen_mm - predicted_mm, -MOST_MM, MOST_MM) * (np.abs(seen_mm) < NEAR_MM)
    return np.asarray(cv2.GaussianBlur(off, (0, 0), SMOOTH_PX), np.float64)


def _trust(figure: FigureRecord, side_mm: float, size_px: int) -> Floats:
    """A factor on the correction of each pixel: less in phases that the last round made worse."""
    if len(figure.rounds) < 2 or not figure.medians:
        return np.ones((size_px, size_px))
    factors = np.ones(len(Phase))
    before, now = figure.rounds[-2].lost_percent, figure.rounds[-1].lost_percent
    for k, phase in enumerate(Phase):
        if now.get(phase, 0.0) > before.get(phase, 0.0):
            factors[k] = WORSE
    return factors[phase_map(ways_of(figure), side_mm, size_px)]


def round_of(figure: FigureRecord, one: Character, side_mm: float) -> Round:
    """What the writings of a figure show on average."""
    reference = as_ink(figure.wanted())
    scores = [compare_ink(reference, ink, HEADLINE)[0] for ink in one.captured.values()]
    lost = [lost_by_phase(figure, ink[Tone.BINARY], side_mm) for ink in one.captured.values()]
    mean = {phase: round(float(np.mean([share[phase] for share in lost])), 2) for phase in lost[0]}
    return Round(csim_percent=round(100.0 * float(np.mean(scores)), 3), lost_percent=mean)


def lost_by_phase(figure: FigureRecord, ink: Image, side_mm: float) -> dict[str, float]:
    """Wrong pixels (missing or too much) of (128, 128) ink by phase, in percent of the wanted ink."""
    if not figure.medians:
        return {}
    wanted = figure.wanted() > 0.5
    where = phase_map(ways_of(figure), side_mm, len(ink))
    wrong = np.bincount(where[wanted != (ink > 0.5)], minlength=len(Phase))
    share = 100.0 * wrong / max(1, np.count_nonzero(wanted))
    present = np.unique(where)
    return {str(phase): float(share[k]) for k, phase in enumerate(Phase) if k in present}


def phase_table(rounds: Sequence[Round]) -> list[tuple[str, list[float]]]:
    """(phase, its loss in every round) for the phases that the character has."""
    present = [str(phase) for phase in Phase if any(str(phase) in one.lost_percent for one in rounds)]
    return [(phase, [one.lost_percent.get(phase, 0.0) for one in rounds]) for phase in present]


def lost_in_words(rounds: Sequence[Round]) -> str:
    """The phases of the last round in which most is lost, most first."""
    lost = sorted(rounds[-1].lost_percent.items(), key=lambda item: -item[1]) if rounds else []
    return ", ".join(f"{phase} {share:.1f} %" for phase, share in lost[:3])
