"""Fit the brush of a session: parameters with intervals, condition numbers, held-out scores, and the artefact."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calibrate.artefact import FittedValue, made_by
from calibrate.compare.field import Field
from calibrate.fit.artefact import BrushFit, FittedStage
from calibrate.fit.captures import Captures, Grid, Pressed
from calibrate.fit.fit import STAGES, Fit, fit_presses, zero_touch
from calibrate.fit.heldout import HeldOut, by_cell, leave_cell_out
from calibrate.fit.prior import wide
from model.fitted import NAMES, PARAMETERS
from sessions.progress import Progress, unseen

NORMAL_95 = 1.96
PROPORTIONAL = 3
"""Number of first stages in which every size is proportional to depth: scale and place, heel, zero offset."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Difference between the zero touch that the ink shows and the rig's; 95 % intervals."""

    lift_mm: float
    """Add to `paper.touch_z_mm`: positive if the paper is higher than the rig believes."""
    lift_interval_mm: tuple[float, float]
    along_mm: float
    """Offset of the ink along the heading from where it should lie."""
    along_interval_mm: tuple[float, float]
    reference: str
    """The fit that it is measured against; empty if every size is instead assumed proportional to depth."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fit of a session and all that is printed about it."""

    fit: Fit
    artefact: BrushFit
    held_out: list[HeldOut]
    """Empty with one cell only."""


def fit_session(captures: Captures, view: Field, progress: Progress = unseen) -> Fitted:
    """Fit, leave each cell out in turn, and make the artefact."""
    grid, strokes = captures.grid, captures.strokes
    fit = fit_presses(strokes, grid, captures.radius_mm, captures.length_mm, progress=progress)
    held_out = leave_cell_out(strokes, grid, captures.radius_mm, captures.length_mm, progress)
    parameters: dict[str, FittedValue] = {}
    for name, value, error in zip(NAMES, fit.press.values.tolist(), fit.errors.tolist(), strict=True):
        bounds = PARAMETERS[NAMES.index(name)]
        low, high = _interval(value, error)
        parameters[name] = FittedValue(value=value, low=max(low, bounds.low), high=min(high, bounds.high))
    h0_mm, h0_se_mm = proportional_zero(strokes, grid, captures.radius_mm, captures.length_mm)
    artefact = BrushFit(
        session_id=captures.header.session_id,
        source=captures.header.source,
        recording_sha256=captures.recording_sha256,
        calibration=captures.calibration.digest if captures.calibration else "",
        software=made_by(),
        radius_mm=captures.radius_mm,
        length_mm=captures.length_mm,
        strokes=len(strokes),
        cells=tuple(by_cell(strokes)),
        mm_per_px=view.mm_per_px,
        parameters=parameters,
        edges_mm=tuple(tuple(tuple(terms) for terms in side) for side in fit.press.edges.tolist()),
        ends_mm=tuple(tuple(terms) for terms in fit.press.ends.tolist()),
        stages=tuple(
            FittedStage(name=s.name, condition=s.condition if math.isfinite(s.condition) else None) for s in fit.stages
        ),
        from_strokes=dict(zip(NAMES, fit.from_strokes.tolist(), strict=True)),
        proportional_h0_mm=h0_mm,
        proportional_h0_se_mm=h0_se_mm,
        csim_percent={row.model: row.csim for row in held_out},
    )
    return Fitted(fit, artefact, held_out)


def proportional_zero(strokes: list[Pressed], grid: Grid, radius_mm: float, length_mm: float) -> tuple[float, float]:
    """(h0, its standard deviation) in mm with every size proportional to depth; with one depth only, the prior's."""
    fit = fit_presses(strokes, grid, radius_mm, length_mm, residual=False, stages=STAGES[:PROPORTIONAL], prior=wide())
    at = NAMES.index("h0_mm")
    return float(fit.press.values[at]), float(fit.errors[fit.free.index("h0_mm")])


def correction(captures: Captures, artefact: BrushFit, reference: BrushFit | None) -> Correction:
    """Correction of the rig's zero touch: relative to an earlier fit of the same brush if given, else absolute."""
    if reference is not None:
        before = reference.press()
        now, errors = zero_touch(before, captures.strokes, captures.grid)
        lift, along = (float(v) for v in (now.values - before.values)[1:3])
        lift_se, along_se = (float(v) for v in errors)
        return Correction(lift, _interval(lift, lift_se), along, _interval(along, along_se), reference.session_id)
    lift, error = artefact.proportional_h0_mm, artefact.proportional_h0_se_mm
    along = artefact.parameters["origin_mm"]
    ends = (along.low if along.low is not None else -1e9, along.high if along.high is not None else 1e9)
    return Correction(lift, _interval(lift, error), along.value, ends, "")


def _interval(value: float, error: float) -> tuple[float, float]:
    return value - NORMAL_95 * error, value + NORMAL_95 * error
