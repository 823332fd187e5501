"""`brushloop fit SESSION` for presses: the fitted brush of a session, its immutable file, its tables and its page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import model_validator

from brushloop.calibrate.artefact import SessionFit, load_artefact, made_by, put_to_use
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.captures import (
    FEWEST_CELLS,
    Captures,
    Estimate,
    Floats,
    Size,
    by_cell,
    middle,
    read_presses,
    sizes_of,
)
from brushloop.calibrate.fit.fit import fit_presses as fit_parameters
from brushloop.calibrate.fit.fit import zero_touches
from brushloop.calibrate.fit.heldout import HeldOut, leave_cell_out
from brushloop.calibrate.fit.report import write_fit_page
from brushloop.calibrate.report import framed, source_label, source_note
from brushloop.calibrate.stats import student_95
from brushloop.model.fitted import MODES, NAMES, TERMS, FittedPress
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen

FOLDER = "brushfit"
"""Folder of a session that holds its fits."""
PLANE = 3
"""Numbers of a plane in depth and tilt."""


class BrushFit(SessionFit):
    """A fitted brush, with its strokes and software. Equal inputs give an equal file."""

    radius_mm: float
    length_mm: float
    strokes: int
    cells: tuple[tuple[float, float], ...]
    """Depth in mm and tilt in deg of the strokes, each cell once."""
    mm_per_px: float
    parameters: dict[str, float]
    """They describe a mark together; on its own none is comparable between brushes. See docs/brushfit.md."""
    touch_errors_mm: tuple[tuple[float, float], ...]
    """Depth and place along the heading of the zero touch of each cell, for a fit to the others; empty for one cell."""
    edges_mm: tuple[tuple[tuple[float, ...], ...], ...]
    ends_mm: tuple[tuple[float, ...], ...]
    csim_percent: dict[str, float]
    """Leave-cell-out CSIM by model."""

    def press(self) -> FittedPress:
        """The fitted brush."""
        values = np.array([self.parameters[name] for name in NAMES])
        return FittedPress(self.radius_mm, self.length_mm, values, np.array(self.edges_mm), np.array(self.ends_mm))

    @model_validator(mode="after")
    def _whole(self) -> Self:
        shapes = (2, MODES, TERMS), (2, TERMS)
        own_shapes = np.array(self.edges_mm).shape, np.array(self.ends_mm).shape
        if set(self.parameters) != set(NAMES) or own_shapes != shapes:
            raise ValueError(f"parameters: expected {', '.join(NAMES)}, with edges and ends of shapes {shapes}")
        return self


@dataclass(frozen=True, slots=True)
class FitRequest:
    """What is fitted, and how."""

    session: Path
    mm_per_px: float = MM_PER_PX
    """Scale of the images."""
    calibration: Path | None = None
    """Artefact; None is the one in use."""
    reference: Path | None = None
    """An earlier fit of the same brush, relative to which the zero touch is corrected."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Difference between the zero touch that the ink shows and that of an earlier fit of the same brush."""

    lift_mm: Estimate
    """Add to `paper.touch_z_mm`: positive if the paper is higher than the rig believes."""
    along_mm: Estimate
    """Offset of the ink along the heading from where it should lie."""
    reference: str
    """The session of the earlier fit."""

    def lines(self) -> Iterator[str]:
        """What the command prints."""
        yield f"Zero touch relative to the fit of {self.reference}, with all else of the brush held:"
        yield f"  paper.touch_z_mm: add {self.lift_mm} mm, 95 % interval in brackets"
        yield f"  along the heading: the ink is off by {self.along_mm} mm"
        if self.lift_mm.low <= 0.0 <= self.lift_mm.high:
            yield "  The interval includes 0: leave rig.toml as it is."


@dataclass(frozen=True, slots=True)
class Fitted:
    """The brush that was fitted to captures, and what they say about it."""

    captures: Captures
    fit: BrushFit
    sizes: list[Size]
    """Empty where the session has too few cells for an interval."""
    held_out: list[HeldOut]
    """Empty with one cell only."""

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        from rich.table import Table

        header, strokes = self.captures.session.header, self.captures.strokes
        label = source_label(header.source, [header.brush])
        yield f"{source_note(header.source, header.brush)}; {len(strokes)} presses fitted"
        for name, why in self.captures.refused:
            yield f"left out: {name}: {why}"
        if self.sizes:
            title = f"sizes of the marks with 95 % intervals ({label})"
            at = "at {:g} mm, {:g}°".format(*middle(strokes))
            sizes = Table("size, mm", at, "per mm of depth", "per degree of tilt", title=title)
            for size in self.sizes:
                sizes.add_row(size.name, str(size.here), str(size.by_depth), str(size.by_tilt))
            yield sizes
        else:
            yield f"Intervals of the sizes of the marks need {FEWEST_CELLS} combinations of depth and tilt."
        if self.held_out:
            scores = Table("model", "n", "CSIM", "SSIM", title=f"leave one cell out, mm, binary, percent ({label})")
            for row in self.held_out:
                scores.add_row(row.model, str(row.n), f"{row.csim:.2f}", f"{row.ssim:.2f}")
            yield scores
        else:
            yield "Only one cell: nothing can be held out."


@dataclass(frozen=True, slots=True)
class FitResult:
    """The fitted brush that a session uses from now on."""

    fitted: Fitted
    path: Path
    page: Path
    correction: Correction | None

    @property
    def fit(self) -> BrushFit:
        """The contents of the file."""
        return self.fitted.fit

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        yield from self.fitted.lines()
        if self.correction is not None:
            yield from self.correction.lines()
        yield f"Fit: {self.path}"
        yield f"Page: {self.page}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def fit_presses(request: FitRequest, progress: Progress = unseen) -> FitResult:
    """Fit the brush to the presses of a session, put the fit to use and write its page. Raises `CalibrationError`."""
    reference = load_artefact(request.reference, BrushFit) if request.reference is not None else None
    view = Field(mm_per_px=request.mm_per_px)
    captures = read_presses(request.session, view, request.calibration, progress)
    fitted = fit_session(captures, view, progress)
    path = put_to_use(fitted.fit, Recording(request.session).path.parent, FOLDER)
    page = write_fit_page(captures, fitted.fit.press(), fitted.sizes, fitted.held_out, path)
    return FitResult(fitted, path, page, None if reference is None else correction(captures, reference))


def fit_session(captures: Captures, view: Field, progress: Progress = unseen) -> Fitted:
    """Fit, leave each cell out in turn, and measure the marks."""
    grid, strokes = captures.grid, captures.strokes
    press = fit_parameters(strokes, grid, captures.radius_mm, captures.length_mm)
    held_out, errors = leave_cell_out(strokes, grid, press, progress=progress, store=captures.session.store)
    fit = BrushFit(
        session_id=captures.session.header.session_id,
        source=captures.session.header.source,
        recording_sha256=captures.session.sha256,
        calibration=captures.session.calibration_digest,
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
    return Fitted(captures, fit, sizes_of(strokes, grid), held_out)


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
