"""Similarity by number of fitted strokes: fits from a few presses, scored on all others of their session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from brushloop.calibrate.compare.place import KEYS, Alignment, Tone, brush_of, loop_pixels, pack
from brushloop.calibrate.pool import Scheduler
from brushloop.calibrate.validate.heldout import Refit, RefitJob, bezier_pixels, refit_job, stroke_of
from brushloop.calibrate.validate.jobs import ABSENT, ScoreJob, score_job
from brushloop.calibrate.validate.report.data import Step
from brushloop.calibrate.validate.run import CHUNK, Outcome
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress

COUNTS = (1, 2, 3, 5, 9, 15, 30, 60)
DRAWS = 2
"""Random draws to average, since a fit from few presses depends on which are drawn."""
MAX_SCORED = 200
MIN_LEFT = 5
JUDGED = KEYS.index((Alignment.MM, Tone.BINARY))


@dataclass(frozen=True, slots=True)
class Trial:
    """One fit: the rows it is fitted to, and those it is scored on."""

    session: int
    count: int
    chosen: tuple[int, ...]
    scored: tuple[int, ...]


def similarity_by_strokes(outcome: Outcome, scheduler: Scheduler, progress: Progress) -> tuple[Step, ...]:
    """Scores of each session by number of fitted strokes; none for a session with too few presses."""
    jobs: dict[str, tuple[Trial, RefitJob]] = {}
    for trial in _trials(outcome):
        brush = brush_of(outcome.sessions[trial.session].header)
        strokes = tuple(stroke_of(outcome.rows, k) for k in trial.chosen)
        job = RefitJob(strokes, float(brush.radius_mm), float(brush.length_mm), outcome.options.view)
        jobs[f"{job.key}:{len(jobs)}"] = (trial, job)
    waiting = ((name, job) for name, (_, job) in jobs.items() if name.partition(":")[0] not in outcome.store)
    for done, (name, found) in enumerate(scheduler.run(refit_job, waiting), 1):
        outcome.store.put(name.partition(":")[0], asdict(found))
        progress("fits from few strokes", done, len(jobs))
    sums: dict[tuple[int, int, str], list[np.ndarray]] = {}
    for name, (trial, _) in jobs.items():
        fit = Refit(**outcome.store.get(name.partition(":")[0]))
        for model, scores in _scored(outcome, trial, fit, scheduler):
            sums.setdefault((trial.session, trial.count, model), []).append(scores)
    steps: list[Step] = []
    for (session, count, model), found in sorted(sums.items()):
        scores = np.concatenate(found)
        mean = 100.0 * scores.mean(axis=0)
        ident = outcome.sessions[session].header.session_id
        csim, ssim = (round(float(value), 6) for value in mean)
        steps.append(Step(session_id=ident, strokes=count, model=model, csim=csim, ssim=ssim, n=len(scores)))
    return tuple(steps)


def _trials(outcome: Outcome) -> Iterator[Trial]:
    for session in range(len(outcome.sessions)):
        cut = outcome.rows.cut
        cells = [group[~cut[group]] for number, _, group in outcome.rows.groups if number == session]
        for draw in range(DRAWS):
            rng = np.random.default_rng([draw, session])
            # Every cell once before any cell twice, as a person would choose.
            groups = [[int(k) for k in rng.permutation(group)] for group in cells if len(group)]
            groups = [groups[int(g)] for g in rng.permutation(len(groups))]
            deepest = max(map(len, groups), default=0)
            order = [group[depth] for depth in range(deepest) for group in groups if depth < len(group)]
            for count in COUNTS:
                left = order[count:]
                if len(left) >= MIN_LEFT:
                    step = max(1, -(-len(left) // MAX_SCORED))
                    yield Trial(session, count, tuple(order[:count]), tuple(sorted(left[::step])))


def _scored(outcome: Outcome, trial: Trial, fit: Refit, scheduler: Scheduler) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (model, (n, 2) CSIM and SSIM) in millimetres, binary."""
    brush, view = brush_of(outcome.sessions[trial.session].header), outcome.options.view
    press = fit.press(float(brush.radius_mm), float(brush.length_mm))
    cells: dict[Condition, list[int]] = {}
    for k in trial.scored:
        cells.setdefault(outcome.rows[k].press.condition, []).append(k)

    def jobs() -> Iterator[tuple[str, ScoreJob]]:
        for cell, group in cells.items():
            bezier = ABSENT if fit.bezier is None else pack(bezier_pixels(fit.bezier, cell, view))
            predictions = (pack(loop_pixels(press.outline(cell.depth_mm, cell.tilt_deg), view)), bezier)
            for start in range(0, len(group), CHUNK):
                chunk = group[start : start + CHUNK]
                presses = tuple(outcome.rows.pixels(k) for k in chunk)
                nothing = tuple(() for _ in chunk)
                yield str(chunk[0]), ScoreJob(presses, predictions, (), nothing, (ABSENT,) * len(chunk))

    found = dict(scheduler.run(score_job, jobs()))
    values = np.concatenate([found[name] for name in sorted(found, key=int)])[:, :, JUDGED]
    yield "CCD-BSM", values[:, 0]
    if fit.bezier is not None:
        yield "Bézier", values[:, 1]
