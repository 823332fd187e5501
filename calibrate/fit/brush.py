"""`brushloop fit SESSION` for presses: the fitted brush of a session, its immutable file, its tables and its page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import model_validator

from brushloop.calibrate.artefact import SessionFit, made_by, put_to_use
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.fit.captures import (
    FEWEST_CELLS,
    Captures,
    Size,
    by_cell,
    middle,
    read_presses,
    sizes_of,
)
from brushloop.calibrate.fit.fit import fit_presses as fit_parameters
from brushloop.calibrate.fit.heldout import HeldOut, leave_cell_out
from brushloop.calibrate.fit.report import write_fit_page
from brushloop.calibrate.report import framed, source_label, source_note
from brushloop.model.fitted import MODES, NAMES, TERMS, FittedPress
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen

FOLDER = "brushfit"
"""Folder of a session that holds its fits."""


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

    @property
    def fit(self) -> BrushFit:
        """The contents of the file."""
        return self.fitted.fit

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        yield from self.fitted.lines()
        yield f"Fit: {self.path}"
        yield f"Page: {self.page}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def fit_presses(request: FitRequest, progress: Progress = unseen) -> FitResult:
    """Fit the brush to the presses of a session, put the fit to use and write its page. Raises `CalibrationError`."""
    view = Field(mm_per_px=request.mm_per_px)
    captures = read_presses(request.session, view, progress)
    fitted = fit_session(captures, view, progress)
    path = put_to_use(fitted.fit, Recording(request.session).path.parent, FOLDER)
    page = write_fit_page(captures, fitted.fit.press(), fitted.sizes, fitted.held_out, path)
    return FitResult(fitted, path, page)


def fit_session(captures: Captures, view: Field, progress: Progress = unseen) -> Fitted:
    """Fit, leave each cell out in turn, and measure the marks."""
    grid, strokes = captures.grid, captures.strokes
    press = fit_parameters(strokes, grid, captures.radius_mm, captures.length_mm)
    held_out = leave_cell_out(strokes, grid, press, progress=progress, store=captures.session.store)
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
        edges_mm=tuple(tuple(tuple(terms) for terms in side) for side in press.edges.tolist()),
        ends_mm=tuple(tuple(terms) for terms in press.ends.tolist()),
        csim_percent={row.model: row.csim for row in held_out},
    )
    return Fitted(captures, fit, sizes_of(strokes, grid), held_out)
