"""From scores to a report: statistics per cell and overall, the best and worst strokes, and their provenance."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import KEYS, Alignment, Key, Tone, brush_of
from brushloop.calibrate.compare.score import SSIM_SETTINGS
from brushloop.calibrate.stats import CEILING, Summary, average, ceiling_values, summarise
from brushloop.calibrate.validate import candidates as who
from brushloop.calibrate.validate.extras import Extras
from brushloop.calibrate.validate.jobs import Press
from brushloop.calibrate.validate.report.data import (
    CandidateInfo,
    Collected,
    DepthMiss,
    Extreme,
    Interval,
    Refused,
    Report,
    Session,
    Stat,
    Step,
    software,
)
from brushloop.calibrate.validate.rows import Rows
from brushloop.calibrate.validate.run import ANOTHER, REPEATED, Outcome
from brushloop.calibrate.validate.sources import LoadedSession, one_source
from brushloop.model.ccdbsm import DomainError
from brushloop.sessions.events import CaptureResult, DipResult, ZeroTouchResult
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.records import Condition
from brushloop.sessions.show import details

MEASURES = ("csim", "ssim")
MAX_CELLS = 60
EXTREMES = 6
JUDGED: Key = (Alignment.MM, Tone.BINARY)
"""Best and worst are judged in millimetres, where place and size count."""
NO_SPREAD: dict[str, Any] = dict.fromkeys(("max", "min", "median", "median_interval"))
PRESSES = {
    ANOTHER: (
        "another press",
        "A capture predicted by other captures of its cell, averaged: how well the brush repeats a press. A model can "
        "do better, because only one of two presses strays from its image.",
    ),
    REPEATED: (
        "robot writing",
        "A stroke pressed again with the depth and tilt that were recovered from it, against the original.",
    ),
    CEILING: (
        CEILING,
        "The score of a perfect model, which draws the best image of each cell: estimated from the similarity of other "
        "presses of the cell.",
    ),
}


Extremes = tuple[list[int], list[int]]
"""Rows of the best and of the worst strokes, from the outermost."""


def report_of(
    outcome: Outcome, command: str, scores_sha256: str, by_strokes: tuple[Step, ...], extras: Extras
) -> tuple[Report, Extremes]:
    """Build one frozen report of a whole run; return with it the rows of its best and worst strokes."""
    cells = list(outcome.rows.first_of_each())
    each_cell = len(cells) <= MAX_CELLS
    stats = _stats(outcome, cells if each_cell else [])
    scored = {stat.model for stat in stats}
    present = [name for name in (*outcome.scores.models, CEILING) if name in scored]
    shown = _shown(present)
    best, worst = _extremes(outcome, shown)
    report = Report(
        source=one_source(outcome.sessions),
        software=software(),
        command=command,
        mm_per_px=outcome.options.view.mm_per_px,
        ssim_settings=SSIM_SETTINGS,
        sessions=tuple(_session(outcome, k, one) for k, one in enumerate(outcome.sessions)),
        rivals=_candidates(outcome, present),
        shown=shown,
        stats=tuple(stats),
        cells_told=each_cell,
        best=tuple(_extreme(outcome, row, shown) for row in best),
        worst=tuple(_extreme(outcome, row, shown) for row in worst),
        refused=tuple(Refused(session_id=s, stroke_id=n, why=why) for s, n, why in outcome.refused),
        by_strokes=by_strokes,
        scores_sha256=scores_sha256,
        loops=extras.loops,
        written=extras.written,
    )
    return report.sealed(), (best, worst)


def _stats(outcome: Outcome, cells: list[Condition]) -> list[Stat]:
    """Of all cells together, then of each of these; the scores of one model at a time are in memory."""
    stratum = outcome.rows.stratum
    groups: list[tuple[Condition | None, NDArray[np.int64]]] = [(None, np.arange(len(outcome.rows)))]
    groups += [(cell, outcome.rows.of_condition(cell)) for cell in cells]
    stats: list[list[Stat]] = [[] for _ in groups]
    top = np.apply_along_axis(ceiling_values, 0, 100.0 * outcome.scores.of(ANOTHER), stratum)
    for model in (*outcome.scores.models, CEILING):
        scores = top if model == CEILING else 100.0 * outcome.scores.of(model)
        for mine, (cell, at) in zip(stats, groups, strict=True):
            for (k, (alignment, tone)), (j, measure) in itertools.product(enumerate(KEYS), enumerate(MEASURES)):
                values = scores[at, k, j]
                found = summarise(values, stratum[at])
                if found is None:
                    continue
                span, rest = found.avg_interval, _spread(found)
                if model == CEILING:
                    own = average(values, stratum[at])
                    span, rest = None if own is None else own.interval, NO_SPREAD
                below = None
                if cell is None and model not in PRESSES:
                    below = average(top[at, k, j] - values, stratum[at])
                mine.append(
                    Stat(
                        model=model,
                        alignment=alignment,
                        tone=tone,
                        measure=measure,
                        cell=None if cell is None else (cell.depth_mm, cell.tilt_deg),
                        n=found.n,
                        avg=_round(found.avg),
                        avg_interval=_interval(span),
                        below=None if below is None else _round(below.mean),
                        below_interval=None if below is None else _interval(below.interval),
                        **rest,
                    )
                )
    return list(itertools.chain.from_iterable(stats))


def _spread(found: Summary) -> dict[str, Any]:
    """The statistics of single scores."""
    return {
        "max": _round(found.max),
        "min": _round(found.min),
        "median": _round(found.median),
        "median_interval": _interval(found.median_interval),
    }


def _shown(present: list[str]) -> str:
    order = (who.FITTED_HELD_OUT, who.FITTED, "ccd-bsmg", "ccd-bsm", *present)
    return next((name for name in order if name in present), "")


def _extremes(outcome: Outcome, model: str) -> Extremes:
    """Rows of the best and of the worst strokes of a model, from the outermost; none without a model."""
    if not model:
        return [], []
    scores = outcome.scores.of(model)[:, KEYS.index(JUDGED), 0]
    known = np.flatnonzero(np.isfinite(scores))
    order = known[np.argsort(scores[known], kind="stable")]
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[::-1][:count].tolist(), order[:count].tolist()


def _extreme(outcome: Outcome, k: int, model: str) -> Extreme:
    row = outcome.rows[k]
    csim, ssim = outcome.scores.one(k, model, JUDGED)
    return Extreme(
        session_id=outcome.sessions[row.session].header.session_id,
        stroke_id=row.press.stroke_id,
        depth_mm=row.press.condition.depth_mm,
        tilt_deg=row.press.condition.tilt_deg,
        model=model,
        csim=_round(100.0 * csim),
        ssim=_round(100.0 * ssim),
    )


def _candidates(outcome: Outcome, present: list[str]) -> tuple[CandidateInfo, ...]:
    files = {one.path: one.sha256 for one in outcome.options.generators}
    by_name = {one.name: one for group in outcome.candidates for one in group}
    bases: dict[str, list[str]] = {}
    for group in outcome.candidates:
        for one in group:
            bases.setdefault(one.name, [])
            if one.basis not in bases[one.name]:
                bases[one.name].append(one.basis)
    infos = [
        CandidateInfo(
            name=name,
            label=by_name[name].label,
            definition=by_name[name].definition,
            basis="; ".join(bases[name]),
            sha256=files[file] if (file := by_name[name].file) is not None else "",
        )
        for name in outcome.scores.models
        if name in by_name
    ]
    for name, (label, definition) in PRESSES.items():
        if name in present:
            basis = "captured presses"
            infos.append(CandidateInfo(name=name, label=label, definition=definition, basis=basis, sha256=""))
    return tuple(infos)


def _session(outcome: Outcome, number: int, one: LoadedSession) -> Session:
    header, calibration = one.header, one.calibration
    mine = np.flatnonzero(outcome.rows.session == number)
    length, width = _ratios(one, outcome.rows, mine)
    scale = None
    if calibration is not None:
        scale = Interval(low=calibration.mm_per_px_low, high=calibration.mm_per_px_high)
    size = ""
    if header.brush_radius_mm is not None and header.brush_length_mm is not None:
        size = f"R = {header.brush_radius_mm:g} mm, L = {header.brush_length_mm:g} mm"
    return Session(
        session_id=header.session_id,
        source=header.source,
        recording=one.recording.path.name,
        recording_sha256=one.sha256,
        recorded_with=header.software,
        robot=f"{header.robot} {header.robot_firmware}".strip(),
        camera=f"{header.camera} {header.lens}".strip(),
        brush=", ".join(part for part in (header.brush, size) if part),
        ink=header.ink,
        paper=header.paper,
        protocol=header.protocol,
        origin=header.origin,
        licence=header.licence,
        strokes=one.count,
        compared=len(mine),
        cut=tuple(outcome.rows[int(k)].press.stroke_id for k in mine[outcome.rows.cut[mine]]),
        calibration=calibration.named if calibration is not None else "",
        mm_per_px=calibration.mm_per_px if calibration is not None else None,
        mm_per_px_interval=scale,
        board_rms_px=calibration.rms_px if calibration is not None else None,
        fit=one.fit.digest if one.fit is not None else "",
        length_ratio=length,
        width_ratio=width,
        deepest_miss=_deepest_miss(one, [outcome.rows[int(k)].press for k in mine]),
        collected=collected_in(one.recording.path.parent),
    )


def _deepest_miss(one: LoadedSession, presses: list[Press]) -> DepthMiss | None:
    known = [(press, reached) for press in presses if (reached := one.reached_mm.get(press.stroke_id)) is not None]
    if not known:
        return None
    press, reached = max(known, key=lambda pair: abs(pair[1] - pair[0].condition.depth_mm))
    return DepthMiss(stroke_id=press.stroke_id, depth_mm=press.condition.depth_mm, reached_mm=round(reached, 3))


def collected_in(folder: Path) -> Collected | None:
    """How the strokes of a folder were collected; None for a recording without a journal. Raises `SessionDamaged`."""
    if not (folder / JOURNAL_NAME).is_file():
        return None
    state = replay(folder / JOURNAL_NAME)
    captures, touches = state.results(CaptureResult), state.results(ZeroTouchResult)
    rejected = [capture for capture in captures if not capture.kept]
    skipped = [dip.skipped for dip in state.results(DipResult) if dip.skipped is not None]
    left_out = [*(capture.press for capture in rejected if not capture.retake), *skipped]
    heights_mm = [touch.touch_z_mm for touch in touches] or [0.0]
    return Collected(
        planned=details(folder).planned,
        photographed=len(captures),
        pressed_again=tuple(capture.press.stroke_id for capture in rejected if capture.retake),
        left_out=tuple(press.stroke_id for press in left_out),
        touches=tuple(f"{touch.method} {touch.touch_z_mm:.2f} mm" for touch in touches),
        moved_mm=_round(max(heights_mm) - min(heights_mm)),
    )


def _ratios(one: LoadedSession, rows: Rows, mine: NDArray[np.int64]) -> tuple[float | None, float | None]:
    """Mean ratio of length and width of uncut marks to those of CCD-BSM for a brush of this size."""
    from brushloop.model.ccdbsm import ccdbsm

    brush = brush_of(one.header)
    drawn: dict[Condition, tuple[float, float]] = {}
    total, strokes = np.zeros(2), 0
    for row in map(rows.__getitem__, map(int, mine)):
        measured, condition = row.press.measured, row.press.condition
        if measured is None or row.press.cut:
            continue
        if condition not in drawn:
            try:
                mark = ccdbsm(brush, condition.depth_mm, condition.tilt_deg)
            except DomainError:
                continue
            drawn[condition] = float(mark.length_mm[0]), float(mark.width_mm[0])
        length, width = drawn[condition]
        total += measured.length_mm / length, measured.breadth_mm / width
        strokes += 1
    if not strokes:
        return None, None
    mean = total / strokes
    return _round(float(mean[0])), _round(float(mean[1]))


def _interval(ends: tuple[float, float] | None) -> Interval | None:
    return None if ends is None else Interval(low=_round(ends[0]), high=_round(ends[1]))


def _round(value: float) -> float:
    """Round to six decimals; further digits would differ between machines."""
    return round(value, 6)
