"""Fit the brush of a session: the brush, sizes of its marks with intervals, held-out scores, and the artefact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.artefact import BrushFit
from brushloop.calibrate.fit.captures import Captures, Floats, by_cell
from brushloop.calibrate.fit.fit import fit_presses, zero_touches
from brushloop.calibrate.fit.heldout import HeldOut, leave_cell_out
from brushloop.calibrate.fit.sizes import FEWEST_CELLS, Estimate, Size, sizes_of
from brushloop.calibrate.stats import student_95
from brushloop.model.fitted import NAMES, FittedPress
from brushloop.sessions.terminal import Progress, unseen

PLANE = 3
"""Numbers of a plane in depth and tilt."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Difference between the zero touch that the ink shows and that of an earlier fit of the same brush."""

    lift_mm: Estimate
    """Add to `paper.touch_z_mm`: positive if the paper is higher than the rig believes."""
    along_mm: Estimate
    """Offset of the ink along the heading from where it should lie."""
    reference: str
    """The session of the earlier fit."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """A fit of a session and all that is printed about it."""

    press: FittedPress
    artefact: BrushFit
    sizes: list[Size]
    """Empty where the session has too few cells for an interval."""
    held_out: list[HeldOut]
    """Empty with one cell only."""


def fit_session(captures: Captures, view: Field, progress: Progress = unseen) -> Fitted:
    """Fit, leave each cell out in turn, and make the artefact."""
    grid, strokes = captures.grid, captures.strokes
    press = fit_presses(strokes, grid, captures.radius_mm, captures.length_mm)
    held_out, errors = leave_cell_out(
        strokes, grid, captures.radius_mm, captures.length_mm, progress=progress, store=captures.store
    )
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
        parameters=dict(zip(NAMES, press.values.tolist(), strict=True)),
        touch_errors_mm=tuple((lift, along) for lift, along in errors.tolist()),
        edges_mm=tuple(tuple(tuple(terms) for terms in side) for side in press.edges.tolist()),
        ends_mm=tuple(tuple(terms) for terms in press.ends.tolist()),
        csim_percent={row.model: row.csim for row in held_out},
    )
    return Fitted(press, artefact, sizes_of(strokes, grid), held_out)


def correction(captures: Captures, reference: BrushFit) -> Correction:
    """Correction of the rig's zero touch relative to an earlier fit of the same brush.

    Raises `CalibrationError` if that was fitted to too few cells.
    """
    errors = np.array(reference.touch_errors_mm)
    if len(errors) < FEWEST_CELLS:
        what = f"was fitted to {len(errors)} combinations of depth and tilt: {FEWEST_CELLS} are needed"
        raise CalibrationError(f"fit of {reference.session_id}", what)
    touches = zero_touches(reference.press(), captures.strokes, captures.grid)
    return Correction(*touch_estimates(touches, errors), reference.session_id)


def touch_estimates(touches_mm: Floats, errors_mm: Floats) -> tuple[Estimate, Estimate]:
    """Depth and place of the zero touch from those of M cells (M, 2) and the errors (N, 2) of the earlier fit's cells.

    A cell's error is taken to be as large in both sessions: N + M - 1 degrees of freedom. The earlier fit may be off by
    a plane in depth and tilt, whose three numbers come from its cells.
    """
    moved = touches_mm.mean(axis=0)
    cells, before = len(touches_mm), len(errors_mm)
    freedom = before + cells - 1
    square = (np.sum(errors_mm**2, axis=0) + np.sum((touches_mm - moved) ** 2, axis=0)) / freedom
    variance = square * (1.0 / cells + PLANE / before)
    factor = student_95(freedom)
    lift, along = (Estimate.of(float(v), float(s), factor) for v, s in zip(moved, variance, strict=True))
    return lift, along
