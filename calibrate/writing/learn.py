"""`brushloop write practice`, `fit` and `learn`: how a brush is dragged, from what it has written.

A practice sheet shows how the brush is dragged: the footprint that is fitted to it leads the brush in plans. Every
round of learning then does three things. The footprint is fitted again to the captured characters, then to each of
their strokes. What these footprints still miss is measured phase by phase: the distance by which the edge of the ink
lies off the predicted edge. Then the points are moved until prediction and miss together give the wanted image, near
where they are, since the miss was measured there. This is iterative learning control with the drawing model as its
learning filter (D. A. Bristow, M. Tharayil, A. G. Alleyne, IEEE Control Systems 26(3), 2006), applied to the picture
of the ink as by Mueller et al., IROS 2013.

A character whose last round was no better than the best one goes back to the best and is settled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from brushloop.calibrate import writing
from brushloop.calibrate.artefact import made_by, put_to_use
from brushloop.calibrate.commands import FitFootprintRequest, LearnRequest, PracticeRequest
from brushloop.calibrate.compare import Image
from brushloop.calibrate.drags.fit import captured_distance
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.session import open_session
from brushloop.calibrate.stroke.preprocess import PX_PER_MM
from brushloop.calibrate.writing import Figure, FootprintArtefact, Plan, PlannedBy, Round, as_points
from brushloop.calibrate.writing.compare import WritingComparison, compare_written, read_writings, round_of
from brushloop.model.characters import plan as trajectories
from brushloop.model.characters.plan import Phase, Reach, without_tilt
from brushloop.model.drag import NAMES, Drawings, Floats, Footprint, fit_each, fit_footprint, inked
from brushloop.model.similarity import binary_scores
from brushloop.sessions.disk import check_writable
from brushloop.sessions.terminal import Progress, unseen

GAIN = 0.7
"""Share of the miss that is corrected in one round."""
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
MM_PER_PX = 0.5
LEAST = 3
"""Least number of strokes: fewer do not distinguish the discs."""
FIGURES, PER_FIGURE, SEED = 10, 2, 1
MARGIN = 0.22
"""Share of the patch at each side that is kept free: ink lands behind its command, and must not reach the edge."""
DEEPEST = 0.3
"""Greatest depth as a share of the brush's length."""


def fit(request: FitFootprintRequest, progress: Progress = unseen) -> Written:
    """Fit the footprint to the figures of a session and put it to use.

    Raises `CalibrationError` if the session is an import, or holds too few strokes.
    """
    opened, refused = open_session(request.session, "drag"), list[tuple[str, str]]()
    figures, cell_mm = writing.recorded_figures(opened.header), opened.strokes[0].cell_mm
    assert cell_mm is not None  # as every stroke that a protocol of figures drew has
    strokes, ink = list[list[Floats]](), list[Image]()
    for stroke_id, name, prepared in read_writings(opened, refused, progress):
        if prepared.cut or name not in figures:
            why = "is cut by the edge of its photograph or patch" if prepared.cut else "is not a figure of its protocol"
            refused.append((stroke_id, why))
            continue
        side_px = round(len(prepared.mask) / PX_PER_MM / MM_PER_PX)
        strokes.append(figures[name])
        coverage = cv2.resize(prepared.mask.astype(np.float32), (side_px, side_px), interpolation=cv2.INTER_AREA)
        ink.append(np.asarray(coverage, np.float32))
    count = sum(map(len, strokes))
    if count < LEAST:
        raise CalibrationError(str(request.session), f"holds {count} usable strokes, at least {LEAST} are needed")
    footprint, csim_percent = fitted(drawings_of(strokes, ink, cell_mm[2]))
    artefact = FootprintArtefact(
        **opened.provenance,
        values=dict(zip(NAMES, footprint.values, strict=True)),
        images=len(ink),
        strokes=count,
        csim_percent=csim_percent,
    )
    path = put_to_use(artefact, opened.recording.path.parent)
    words = (
        f"the footprint fitted to {count} strokes on {len(ink)} patches ({artefact.source}) draws these strokes with "
        f"a CSIM of {csim_percent:.1f} % (ink = 1)"
    )
    said = (*(f"left out: {stroke_id}: {why}" for stroke_id, why in refused), words, str(path))
    return Written(path, said, refused)


def fitted(drawings: Drawings) -> tuple[Footprint, float]:
    """The footprint that draws these best, and the mean CSIM in percent with which it does."""
    footprint = fit_footprint(drawings)
    each = [drawings.only(np.array([k])).paths for k in range(len(drawings.ink))]
    predicted = [inked([footprint] * len(paths), paths, drawings.x_mm, drawings.y_mm) > 0.0 for paths in each]
    agreement = binary_scores(np.array(predicted), drawings.ink > 0.5)[:, 0]
    return footprint, round(100.0 * float(agreement.mean()), 3)


def practice(request: PracticeRequest, _progress: Progress = unseen) -> Written:
    """Write the protocol of a practice sheet, each stroke on a patch of its own. Raises `CalibrationError`."""
    check_writable(request.out)
    by = PlannedBy(radius_mm=request.radius_mm, length_mm=request.length_mm)
    strokes = practice_strokes(request.cell_mm, by.reach, by.length_mm)
    figures = tuple(
        Figure(
            name=f"practice-{number + 1:02d}",
            source=f"practice strokes, seed {SEED}",
            commanded=as_points(strokes[number * PER_FIGURE : (number + 1) * PER_FIGURE]),
        )
        for number in range(FIGURES)
    )
    plan = Plan(model="none: practice", planned_by=by, cell_mm=request.cell_mm, software=made_by(), figures=figures)
    protocol = writing.write_plan(plan, 1, request.out)
    return Written(protocol, (str(protocol),))


def practice_strokes(side_mm: float, reach: Reach, brush_length_mm: float) -> list[Floats]:
    """`FIGURES` x `PER_FIGURE` trajectories (N, 5) on a patch of that side; every third has a sharp turn.

    None is deeper than `DEEPEST` of the brush's length.
    """
    rng = np.random.default_rng(SEED)
    deepest_mm = min(reach.depth_mm[1], math.floor(DEEPEST * brush_length_mm))
    room_mm = (1.0 - 2.0 * MARGIN) * side_mm
    out: list[Floats] = []
    while len(out) < FIGURES * PER_FIGURE:
        length_mm = rng.uniform(0.2, 1.0) * room_mm
        count = max(4, round(length_mm / writing.STEP_MM))
        heading = rng.uniform(-180.0, 180.0) + np.cumsum(rng.normal(0.0, 8.0, count))
        if len(out) % 3 == 0:
            heading[count // 2 :] += rng.choice([-1.0, 1.0]) * rng.uniform(50.0, 150.0)
        places = np.cumsum(trajectories.directions(heading) * length_mm / count, axis=0)
        low, high = places.min(axis=0), places.max(axis=0)
        places += MARGIN * side_mm - low + rng.uniform(0.0, 1.0, 2) * np.maximum(room_mm - (high - low), 0.0)
        depths = rng.uniform(0.1, 1.0, 3) * deepest_mm
        depth = np.interp(np.linspace(0.0, 1.0, count), (0.0, 0.5, 1.0), depths)
        points = np.column_stack((places, depth, np.full(count, writing.TILT_DEG), heading))
        stroke = reach.spaced(np.round(reach.within(points, side_mm), 3))
        if len(stroke) >= 3:
            out.append(stroke)
    return out


def learn(request: LearnRequest, progress: Progress = unseen) -> Written:
    """Make the next plan from what the ink of this one showed. Raises `CalibrationError`."""
    check_writable(request.out)
    following = learned(compare_written(request.session, writing.load_plan(request.plan), progress))
    settled = request.settled_repeats is not None and all(figure.settled for figure in following.figures)
    repeats = (request.settled_repeats if settled else None) or request.repeats
    protocol = writing.write_plan(following, repeats, request.out)
    said = [
        f"{figure.name}: CSIM {figure.rounds[-1].csim_percent:.2f}, ink = 1, mm"
        + ("; no further round helps: the best one is kept" if figure.settled else "")
        for figure in following.figures
    ]
    return Written(protocol, (*said, str(protocol)))


def learned(written: WritingComparison) -> Plan:
    """The next plan of the characters that were captured. Raises `CalibrationError`."""
    plan, writings = written.plan, {character.figure.name: character for character in written.characters}
    if absent := [figure.name for figure in plan.figures if figure.name not in writings]:
        where = str(written.session.recording.path)
        raise CalibrationError(where, f"shows no {absent[0]!r}, so nothing is learned for this character")
    ink = [writings[figure.name].mean_ink() for figure in plan.figures]
    known, drawings = plan.planned_by.footprint, drawings_of([each.strokes for each in plan.figures], ink, plan.cell_mm)
    footprint = fit_footprint(drawings, None if known is None else Footprint(known))
    figures: list[Figure] = []
    for figure, captured in zip(plan.figures, ink, strict=True):
        after = _after(figure, round_of(writings[figure.name], plan.cell_mm))
        if not after.settled:
            after = _corrected(after, captured, footprint, plan.planned_by.reach, plan.cell_mm)
        figures.append(after)
    by = plan.planned_by.model_copy(update={"footprint": footprint.values})
    return plan.model_copy(update={"planned_by": by, "figures": tuple(figures), "software": made_by()})


def drawings_of(strokes: Sequence[Sequence[Floats]], ink: Sequence[Image], side_mm: float) -> Drawings:
    """The strokes, (N, 5) each, that were commanded on every patch, and the ink (S, S) that they left."""
    paths = [[without_tilt(points) for points in of_patch] for of_patch in strokes]
    return Drawings.of(paths, np.stack(ink), *trajectories.grid(side_mm, len(ink[0])))


def _after(figure: Figure, last: Round) -> Figure:
    """The figure with its round added, back at its best; settled if the round has not helped."""
    before = max((each.csim_percent for each in figure.rounds), default=float("-inf"))
    best = figure.commanded if last.csim_percent > before or not figure.best else figure.best
    settled = figure.settled or last.csim_percent < before + LEAST_GAIN_PERCENT
    update = {"rounds": (*figure.rounds, last), "best": best, "settled": settled, "commanded": best}
    return figure.model_copy(update=update)


def _corrected(figure: Figure, captured: Image, footprint: Footprint, reach: Reach, side_mm: float) -> Figure:
    strokes, size_px = figure.strokes, len(captured)
    footprints = fit_each(drawings_of([strokes], [captured], side_mm), footprint)
    miss = missed(captured, trajectories.drawn(footprints, strokes, side_mm, size_px), side_mm)
    miss *= GAIN * _trust(figure, side_mm, size_px)
    near = trajectories.LATER_SPREADS_MM
    moved = trajectories.lead(
        footprints, strokes, figure.wanted, side_mm, reach, added_mm=miss, spreads_mm=near, held=HELD
    )
    simulated = trajectories.covered(trajectories.drawn(footprints, moved, side_mm, size_px) + miss, side_mm)
    return figure.model_copy(update={"commanded": as_points(moved), "simulated": simulated})


def missed(ink: Image, predicted_mm: Floats, side_mm: float) -> Floats:
    """By how much the captured edge lies outside the predicted one, (N, N) mm, negative where it lies inside."""
    size_px = len(ink)
    finer = cv2.resize(ink, (FINER * size_px, FINER * size_px), interpolation=cv2.INTER_CUBIC) > 0.5
    if not finer.any():
        return np.zeros(ink.shape)
    seen = captured_distance(finer[None], side_mm / (FINER * size_px))[0]
    seen_mm = np.asarray(cv2.resize(seen, (size_px, size_px), interpolation=cv2.INTER_AREA), np.float64)
    off = np.clip(seen_mm - predicted_mm, -MOST_MM, MOST_MM) * (np.abs(seen_mm) < NEAR_MM)
    return np.asarray(cv2.GaussianBlur(off, (0, 0), SMOOTH_PX), np.float64)


def _trust(figure: Figure, side_mm: float, size_px: int) -> Floats:
    """A factor on the correction of each pixel: less in phases that the last round made worse."""
    if len(figure.rounds) < 2 or not figure.medians:
        return np.ones((size_px, size_px))
    before, now = (each.lost_percent for each in figure.rounds[-2:])
    factors = [WORSE if now.get(phase, 0.0) > before.get(phase, 0.0) else 1.0 for phase in Phase]
    return np.array(factors)[trajectories.phase_map(figure.paths, side_mm, size_px)]
