"""`brushloop fit SESSION` for presses: the fitted brush, its immutable file, its tables, and its page.

The page shows the fitted outline over the ink of each cell, the sizes of the marks, and the held-out scores.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import model_validator

from brushloop.calibrate.artefact import SessionFit, load_artefact, made_by, put_to_use
from brushloop.calibrate.commands import FitRequest
from brushloop.calibrate.compare import MM_PER_PX, brush_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.fit.captures import (
    FEWEST_CELLS,
    SPREAD_MM,
    Captures,
    Cell,
    Floats,
    Grid,
    Pressed,
    Size,
    by_cell,
    measure,
    middle,
    read_presses,
    sizes_of,
)
from brushloop.calibrate.fit.descent import fit_presses as fit_parameters
from brushloop.calibrate.fit.heldout import FITTED, UNCALIBRATED, HeldOut, leave_cell_out
from brushloop.calibrate.report import (
    COLOURS,
    Axis,
    Marks,
    Panel,
    Point,
    about,
    chart_uri,
    framed,
    ink_uri,
    recording_facts,
    source_label,
    source_note,
    source_point,
    write_page,
)
from brushloop.calibrate.stats import CEILING, NEAR_POINTS, is_near
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import MODES, NAMES, TERMS, FittedPress, fitted_model
from brushloop.model.outline import Outline
from brushloop.model.similarity import csim
from brushloop.model.strokes import StrokeModel, stroke_model
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header
from brushloop.sessions.terminal import Progress, unseen

FOLDER = "brushfit"
"""Folder of a session that holds its fits."""
MARGIN_MM = 1.5
SMOOTH_POINTS = 24


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

    @classmethod
    def model_of(cls, fit: Path | None, header: Header) -> tuple[StrokeModel, BrushFit | None]:
        """The model of a fit and the fit itself; without one, CCD-BSM as published for the brush of a recording.

        Raises `CalibrationError`.
        """
        if fit is None:
            return stroke_model("ccd-bsm", brush_of(header)), None
        artefact = load_artefact(fit, cls)
        return fitted_model(artefact.press(), f"CCD-BSM fitted on {artefact.session_id}"), artefact

    @model_validator(mode="after")
    def _whole(self) -> Self:
        shapes = (2, MODES, TERMS), (2, TERMS)
        own_shapes = np.array(self.edges_mm).shape, np.array(self.ends_mm).shape
        if set(self.parameters) != set(NAMES) or own_shapes != shapes:
            raise ValueError(f"parameters: expected {', '.join(NAMES)}, with edges and ends of shapes {shapes}")
        return self


@dataclass(frozen=True, slots=True)
class FitResult:
    """The fitted brush that a session uses from now on, and what its captures say about it."""

    captures: Captures
    fit: BrushFit
    """The contents of the file."""
    sizes: list[Size]
    """Empty where the session has too few cells for an interval."""
    held_out: list[HeldOut]
    """Empty with one cell only."""
    path: Path
    page: Path

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
            scores = Table(
                "model", "n", "CSIM", "SSIM", title=f"on combinations left out of the fit in turn, percent ({label})"
            )
            for row in self.held_out:
                scores.add_row(row.model, str(row.n), f"{row.csim:.2f}", f"{row.ssim:.2f}")
            yield scores
        else:
            yield "Only one cell: nothing can be held out."
        yield f"Fit: {self.path}"
        yield f"Page: {self.page}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def fit(request: FitRequest, progress: Progress = unseen) -> FitResult | Written:
    """Fit what the session holds, presses or drags. Raises `CalibrationError`."""
    from brushloop.calibrate.drags.report import fit_session

    first = next(Recording(request.session).stroke_records(), None)
    if first is not None and first.kind == "drag":
        return fit_session(request, progress)
    return fit_presses(request, progress)


def fit_presses(request: FitRequest, progress: Progress = unseen) -> FitResult:
    """Fit the brush to the presses of a session, leave each cell out in turn, and measure the marks.

    The session uses the fit from now on, and its page is written. Raises `CalibrationError`.
    """
    if request.prior is not None:
        raise CalibrationError("--prior", "adapts a fit of drags, and this session holds presses")
    captures = read_presses(request.session, progress)
    session, grid, strokes = captures.session, captures.grid, captures.strokes
    press = fit_parameters(strokes, grid, captures.radius_mm, captures.length_mm)
    held_out = leave_cell_out(strokes, grid, press, progress=progress, store=session.store)
    fit = BrushFit(
        session_id=session.header.session_id,
        source=session.header.source,
        recording_sha256=session.sha256,
        calibration=session.calibration_digest,
        software=made_by(),
        radius_mm=captures.radius_mm,
        length_mm=captures.length_mm,
        strokes=len(strokes),
        cells=tuple(by_cell(strokes)),
        mm_per_px=MM_PER_PX,
        parameters=dict(zip(NAMES, press.values.tolist(), strict=True)),
        edges_mm=press.edges.tolist(),
        ends_mm=press.ends.tolist(),
        csim_percent={row.model: row.csim for row in held_out},
    )
    sizes, path = sizes_of(strokes, grid), put_to_use(fit, session.recording.path.parent, FOLDER)
    page = _write_page(captures, press, sizes, held_out, path)
    return FitResult(captures, fit, sizes, held_out, path, page)


def _write_page(
    captures: Captures, press: FittedPress, sizes: Sequence[Size], held_out: Sequence[HeldOut], path: Path
) -> Path:
    """Write the page of the fit at `path` beside it; returns the page's path. Raises OSError."""
    session = captures.session
    header = session.header
    cells = by_cell(captures.strokes)
    published = FittedPress(captures.radius_mm, captures.length_mm)
    return write_page(
        path.with_suffix(".html"),
        "fit.html.j2",
        **about(header),
        session=header.session_id,
        window=_window(captures, (press, published)),
        cells=[_cell(cell, strokes, press, published, captures.grid) for cell, strokes in cells.items()],
        verdict=list(_verdict(captures, held_out)),
        trust=[source_point(header.source), *_trust(captures, held_out)],
        chart=_chart(captures, press),
        measured=sizes,
        middle="{:g} mm, {:g}°".format(*middle(captures.strokes)),
        held_out=held_out,
        refused=captures.refused,
        facts=[
            *recording_facts(header, session.recording.path.name, session.sha256, session.calibration),
            ("images", f"{captures.grid.px_mm:g} mm per pixel"),
            ("fitted with", made_by()),
            ("artefact", path.name),
        ],
    )


def _window(captures: Captures, presses: tuple[FittedPress, ...]) -> tuple[float, float, float, float]:
    """The (left, top, width, height) in mm, y downward, that holds all ink and every outline."""
    grid = captures.grid
    inked = np.any([stroke.ink > 0.5 for stroke in captures.strokes], axis=0)
    x, y = grid.x_mm[inked.any(axis=0)], -grid.y_mm[inked.any(axis=1)]
    low, high = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
    for loop in (_outline(press, cell) for press in presses for cell in by_cell(captures.strokes)):
        if loop is not None:
            points = loop.points.reshape(-1, 2) * np.array([1.0, -1.0])
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    (left, top), (width, height) = (low - MARGIN_MM).tolist(), (high - low + 2.0 * MARGIN_MM).tolist()
    return round(left, 3), round(top, 3), round(width, 3), round(height, 3)


def _cell(cell: Cell, strokes: list[Pressed], press: FittedPress, published: FittedPress, grid: Grid) -> dict[str, Any]:
    """One picture: the mean ink of the cell's presses, and both outlines as SVG paths in mm."""
    mean = np.mean([stroke.ink for stroke in strokes], axis=0).astype(np.float32)
    left, top = float(grid.x_mm[0]) - 0.5 * grid.px_mm, -float(grid.y_mm[0]) - 0.5 * grid.px_mm
    across, down = len(grid.x_mm) * grid.px_mm, len(grid.y_mm) * grid.px_mm
    return {
        "depth_mm": f"{cell[0]:g}",
        "tilt_deg": f"{cell[1]:g}",
        "presses": len(strokes),
        "ink": ink_uri(mean),
        "place": (round(left, 3), round(top, 3), round(across, 3), round(down, 3)),
        "fitted": _path(press, cell),
        "published": _path(published, cell),
        "csim": _csim(press, cell, strokes, grid),
    }


def _csim(press: FittedPress, cell: Cell, strokes: list[Pressed], grid: Grid) -> str:
    """Average CSIM of the fit and the presses that it was fitted to, percent; empty where it draws no mark."""
    try:
        drawn = np.asarray(press.chance(*cell, grid.x_mm, grid.y_mm, SPREAD_MM) > 0.5, np.float32)
    except DomainError:
        return ""
    if not drawn.any():
        return ""
    seen = [np.asarray(stroke.ink > 0.5, np.float32) for stroke in strokes]
    return f"{100.0 * np.mean([csim(drawn, image) for image in seen if image.any()]):.1f}"


def _outline(press: FittedPress, cell: Cell) -> Outline | None:
    try:
        return press.outline(*cell)
    except DomainError:  # so light that the brush leaves no mark
        return None


def _path(press: FittedPress, cell: Cell) -> str:
    """The outline as an SVG path, x to the right and y downward in mm; empty where the brush leaves no mark."""
    loop = _outline(press, cell)
    if loop is None:
        return ""
    points = np.round(np.asarray(loop.points[0], np.float64) * [1.0, -1.0], 2)
    x, y = points[0, 0].tolist()
    curves = "".join(f"Q{a:g} {b:g} {c:g} {d:g}" for (a, b), (c, d) in points[:, 1:].tolist())
    return f"M{x:g} {y:g}{curves}Z"


def _chart(captures: Captures, press: FittedPress) -> str:
    """Length and width against depth: the ink of each press as a point, the fit as a line for each tilt."""
    strokes, grid = captures.strokes, captures.grid
    depths = sorted({stroke.depth_mm for stroke in strokes})
    tilts = sorted({stroke.tilt_deg for stroke in strokes})
    shown = tilts if len(tilts) <= len(COLOURS) else [tilts[0], tilts[len(tilts) // 2], tilts[-1]]
    seen = {tilt: np.array([_measured(s, grid) for s in strokes if s.tilt_deg == tilt]) for tilt in shown}
    smooth = np.linspace(depths[0], depths[-1], SMOOTH_POINTS).tolist()
    drawn = {tilt: np.array([_fitted(press, depth, tilt, grid.x_mm) for depth in smooth]) for tilt in shown}
    panels: list[Panel] = []
    for column, what in ((1, "length"), (2, "width")):
        marks: list[Marks] = []
        for tilt, colour in zip(shown, COLOURS, strict=False):
            points, line = seen[tilt], drawn[tilt]
            marks.append(Marks(points[:, 0], points[:, column], colour, f"α {tilt:g}°", dot_px=6.0))
            marks.append(Marks(line[:, 0], line[:, column], colour, line_px=1.5))
        panels.append(Panel(what, Axis("commanded depth H, mm"), Axis(f"{what} of the mark, mm"), marks))
    header = captures.session.header
    return chart_uri(panels, (960, 320), source_label(header.source, [header.brush]))


def _measured(stroke: Pressed, grid: Grid) -> tuple[float, float, float]:
    """Depth of a press, length and width of its ink, mm."""
    toward_tip, toward_heel, width = measure(stroke, grid).tolist()
    return stroke.depth_mm, toward_tip + toward_heel, width


def _fitted(press: FittedPress, depth_mm: float, tilt_deg: float, x_mm: Floats) -> tuple[float, float, float]:
    """Depth of a press, length and width of the mark that is predicted, mm; NaN where there is none."""
    try:
        sizes = press.sizes(depth_mm, tilt_deg)
        width = np.maximum(press.edges_at(depth_mm, tilt_deg, x_mm), 0.0).sum(axis=0).max()
    except DomainError:
        return depth_mm, math.nan, math.nan
    return depth_mm, float(sizes.tip + sizes.heel), float(width)


def _verdict(captures: Captures, held_out: Sequence[HeldOut]) -> Iterator[str]:
    brush = captures.session.header.brush or "a brush without a name"
    presses, cells = len(captures.strokes), len(by_cell(captures.strokes))
    yield f"The stroke model was fitted to {presses} presses at {cells} combinations of H and α: {brush}."
    scores = {row.model: row.csim for row in held_out}
    if FITTED not in scores:
        yield "Only one combination was pressed, so how well it predicts others is not known."
        return
    ceiling = f"; a perfect model would reach {scores[CEILING]:.1f} %" if CEILING in scores else ""
    yield (
        f"On combinations that were left out of the fit it predicts the ink with a CSIM of {scores[FITTED]:.1f} %, "
        f"the model as published with {scores[UNCALIBRATED]:.1f} %{ceiling}."
    )


def _trust(captures: Captures, held_out: Sequence[HeldOut]) -> Iterator[Point]:
    below = {row.model: row.below for row in held_out}
    if not below:
        yield Point(False, "One combination of H and α does not show how the mark changes with depth or tilt.")
    elif (off := below.get(FITTED)) is not None:
        span = "" if off.avg_interval is None else " (95 % {:.1f} to {:.1f})".format(*off.avg_interval)
        words = f"Held out, the fit is {off.avg:.1f} points of CSIM{span} below the ceiling"
        yield Point(is_near(off.avg, off.avg_interval), f"{words}; {NEAR_POINTS:g} or less is near.")
    else:
        yield Point(None, "No combination was pressed twice, so the repeatability of the brush is not known here.")
    if captures.refused:
        yield Point(False, f"{len(captures.refused)} presses could not be used; each is named below.")
    else:
        yield Point(True, "Every press was used.")
    yield Point(None, "The pictures above show presses that were fitted; judge the fit by the held-out scores.")
