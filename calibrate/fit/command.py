"""`brushloop fit SESSION` for presses: the fitted brush, its immutable file, its tables, and its page.

The page shows the fitted outline over the ink of each condition, the sizes of the marks, and the held-out scores. The
intervals of the sizes are those of the jackknife: each condition is left out in turn, so they hold the differences
between presses and how far the brush is from a plane.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import model_validator

from brushloop.calibrate.artefact import FITS, FittedValue, SessionFit, current, made_by, put_to_use
from brushloop.calibrate.commands import FitRequest
from brushloop.calibrate.compare import MM_PER_PX, SHOWN_MM, SHOWN_ROWS, brush_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written
from brushloop.calibrate.fit.fit import SPREAD_MM, Floats, fit_presses
from brushloop.calibrate.fit.heldout import FITTED, leave_condition_out
from brushloop.calibrate.presses import Refused, read_for_fit
from brushloop.calibrate.report import COLOURS, Point, about, chart_uri, framed, picture_grid, source_point, write_page
from brushloop.calibrate.scores import Stat
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stats import NEAR_POINTS, is_near, student_95
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import MODES, NAMES, TERMS, FittedPress, fitted_model
from brushloop.model.presses import SIZES, DepthTilt, Presses, measure, plane_at
from brushloop.model.similarity import csim
from brushloop.model.strokes import StrokeModel, stroke_model
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header
from brushloop.sessions.terminal import Progress, unseen

PUBLISHED = Path("published")
"""As `--fit`: no fit, but the model of the paper."""
FEWEST_CONDITIONS = 5
SMOOTH_POINTS = 24


class BrushFit(SessionFit):
    """A fitted brush, with its strokes and software. Equal inputs give an equal file."""

    FOLDER: ClassVar[str] = FITS

    radius_mm: float
    length_mm: float
    strokes: int
    cells: tuple[tuple[float, float], ...]
    """Depth in mm and tilt in deg of the strokes, each condition once."""
    mm_per_px: float
    parameters: dict[str, float]
    """They describe a mark together; on its own none is comparable between brushes. See docs/brushfit.md."""
    across_mm: tuple[tuple[tuple[float, ...], ...], ...]
    ends_mm: tuple[tuple[float, ...], ...]
    csim_percent: dict[str, float]
    """Leave-condition-out CSIM by model."""

    def press(self) -> FittedPress:
        """The fitted brush."""
        values = np.array([self.parameters[name] for name in NAMES])
        return FittedPress(self.radius_mm, self.length_mm, values, np.array(self.across_mm), np.array(self.ends_mm))

    @classmethod
    def model_of(cls, fit: Path | None, session: OpenSession) -> tuple[StrokeModel, BrushFit | None]:
        """The model of a fit, the one in use of the session by default, and that fit.

        CCD-BSM as published for its brush and None if there is no fit, or for `PUBLISHED`. Raises `CalibrationError`.
        """
        fit = fit or current(session.recording.path.parent, FITS)
        if fit is None or fit == PUBLISHED:
            return replace(stroke_model("ccd-bsm", brush_of(session.header)), label="CCD-BSM as published"), None
        artefact = cls.read(fit)
        return fitted_model(artefact.press(), f"CCD-BSM fitted on {artefact.session_id}"), artefact

    @model_validator(mode="after")
    def _whole(self) -> Self:
        shapes = (2, MODES, TERMS), (2, TERMS)
        own_shapes = np.array(self.across_mm).shape, np.array(self.ends_mm).shape
        if set(self.parameters) != set(NAMES) or own_shapes != shapes:
            raise ValueError(f"parameters: expected {', '.join(NAMES)}, with across_mm and ends_mm of shapes {shapes}")
        return self


Sizes = dict[str, tuple[FittedValue, ...]]
"""Each size of the marks by its name: mm in the middle of the session's depths and tilts, mm per mm of depth, mm per
degree of tilt."""


def sizes_of(presses: Presses) -> Sizes:
    """Every size; empty where the conditions are too few for an interval, or do not span depth and tilt without one."""
    inked = presses.pick(np.flatnonzero((presses.ink > 0.5).any(axis=(1, 2))).tolist())
    groups = list(inked.conditions.values())
    if len(groups) < FEWEST_CONDITIONS:
        return {}
    measured = np.array([measure(ink, inked.grid) for ink in inked.ink])

    def plane(rows: Sequence[int]) -> Floats:
        return plane_at(inked.commands[rows], measured[rows], inked.middle)

    every = range(len(inked))
    try:
        whole, without = plane(every), np.array([plane([k for k in every if k not in group]) for group in groups])
    except ValueError:
        return {}
    variance = (1.0 - 1.0 / len(groups)) * ((without - whole) ** 2).sum(axis=0)
    reach = student_95(len(groups) - 1) * np.sqrt(variance)
    ends = np.stack([whole, whole - reach, whole + reach], axis=-1).swapaxes(0, 1).tolist()
    return {
        name: tuple(FittedValue(value=value, low=low, high=high) for value, low, high in each)
        for name, each in zip(SIZES, ends, strict=True)
    }


@dataclass(frozen=True, slots=True)
class FitResult:
    """The fitted brush that a session uses from now on, and what its presses say about it."""

    session: OpenSession
    presses: Presses
    left_out: list[Refused]
    """Presses that cannot be used or are cut by the edge of their photograph."""
    fit: BrushFit
    """The contents of the file."""
    sizes: Sizes
    """Empty where the session has too few conditions for an interval."""
    held_out: list[Stat]
    """Empty with one condition only."""
    path: Path

    @property
    def page(self) -> Path:
        """The page beside the file."""
        return self.path.with_suffix(".html")

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        from rich.table import Table

        label, note = about(self.session.header).values()
        yield f"{note}; {len(self.presses)} presses fitted"
        for name, why in self.left_out:
            yield f"left out: {name}: {why}"
        if self.sizes:
            title = f"sizes of the marks with 95 % intervals ({label})"
            at = "at {:g} mm, {:g}°".format(*self.presses.middle)
            sizes = Table("size, mm", at, "per mm of depth", "per degree of tilt", title=title)
            for name, values in self.sizes.items():
                sizes.add_row(name, *map(str, values))
            yield sizes
        else:
            yield f"Intervals of the sizes of the marks need {FEWEST_CONDITIONS} combinations of depth and tilt."
        if self.held_out:
            scores = Table(
                "model", "n", "CSIM", "SSIM", title=f"scores on combinations left out of the fit, percent ({label})"
            )
            for row in self.held_out:
                scores.add_row(row.model, str(row.csim.n), f"{row.csim.avg:.2f}", f"{row.ssim.avg:.2f}")
            yield scores
        else:
            yield "There is only one combination of depth and tilt, so none can be left out of the fit."
        yield f"Fit: {self.path}"
        yield f"Page: {self.page}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def fit(request: FitRequest, progress: Progress = unseen, opened: Recording | None = None) -> FitResult | Written:
    """Fit what the session holds, presses or drags; `opened` is its recording. Raises `CalibrationError`."""
    from brushloop.calibrate.drags.report import fit_session

    recording = opened or Recording(request.session)
    first = next(recording.stroke_records(), None)
    if first is not None and first.kind == "drag":
        return fit_session(request, progress)
    return fit_press_session(request, progress, recording)


def fit_press_session(request: FitRequest, progress: Progress = unseen, opened: Recording | None = None) -> FitResult:
    """Fit the brush to the presses of a session, leave each condition out in turn, and measure the marks.

    The session uses the fit from now on, and its page is written. Raises `CalibrationError`.
    """
    if request.prior is not None:
        raise CalibrationError("--prior", "adapts only fits of drags, but this session holds presses")
    session, presses, refused = read_for_fit(opened or request.session, progress)
    press = fit_presses(presses)
    held_out, _ = leave_condition_out(presses, press, progress=progress, store=session.store)
    fit = BrushFit(
        **session.provenance,
        radius_mm=presses.radius_mm,
        length_mm=presses.length_mm,
        strokes=len(presses),
        cells=tuple(presses.conditions),
        mm_per_px=MM_PER_PX,
        parameters=dict(zip(NAMES, press.values.tolist(), strict=True)),
        across_mm=press.across.tolist(),
        ends_mm=press.ends.tolist(),
        csim_percent={row.model: row.csim.avg for row in held_out},
    )
    path = put_to_use(fit, session.recording.path.parent)
    result = FitResult(session, presses, refused, fit, sizes_of(presses), held_out, path)
    _write_page(result, press)
    return result


def _write_page(result: FitResult, press: FittedPress) -> None:
    """Write the page of the fit. Raises OSError."""
    presses, header = result.presses, result.session.header
    published = FittedPress(presses.radius_mm, presses.length_mm)
    write_page(
        result.page,
        "fit.html.j2",
        **about(header),
        result=result,
        window=SHOWN_MM,
        conditions={at: _picture(presses, at, numbers, press, published) for at, numbers in presses.conditions.items()},
        trust=[source_point(header.source), *_trust(result)],
        chart=_chart(presses, press, header),
        provenance=(("fitted with", made_by()), ("artefact", result.path.name)),
    )


def _picture(
    presses: Presses, condition: DepthTilt, numbers: list[int], press: FittedPress, published: FittedPress
) -> dict[str, Any]:
    """One picture: the mean ink of the condition's presses, and both outlines as SVG paths in mm."""
    grid, ink = presses.grid, presses.ink[numbers]
    alike: list[float] = []
    with contextlib.suppress(DomainError):  # so light that the brush leaves no mark
        drawn = np.asarray(press.chance(*condition, grid.x_mm, grid.y_mm, SPREAD_MM) > 0.5, np.float32)
        if drawn.any():
            alike = [csim(drawn, seen) for seen in np.asarray(ink > 0.5, np.float32) if seen.any()]
    return {
        "presses": len(numbers),
        "ink": ink.mean(axis=0).astype(np.float32)[SHOWN_ROWS],
        "fitted": _path(press, condition),
        "published": _path(published, condition),
        "csim": f"{100.0 * np.mean(alike):.1f}" if alike else "",
    }


def _path(press: FittedPress, condition: DepthTilt) -> str:
    """The outline as an SVG path, x to the right and y downward in mm; empty where the brush leaves no mark."""
    try:
        loop = press.outline(*condition)
    except DomainError:  # so light that the brush leaves no mark
        return ""
    points = np.round(np.asarray(loop.points[0], np.float64) * [1.0, -1.0], 2)
    x, y = points[0, 0].tolist()
    curves = "".join(f"Q{a:g} {b:g} {c:g} {d:g}" for (a, b), (c, d) in points[:, 1:].tolist())
    return f"M{x:g} {y:g}{curves}Z"


def _chart(presses: Presses, press: FittedPress, header: Header) -> str:
    """Length and width against depth: the ink of each press as a point, the fit as a line for each tilt."""
    depths, tilts = presses.commands[:, 0], presses.commands[:, 1]
    every = np.unique(tilts).tolist()
    shown = every if len(every) <= len(COLOURS) else [every[0], every[len(every) // 2], every[-1]]
    smooth = np.linspace(float(depths.min()), float(depths.max()), SMOOTH_POINTS).tolist()
    sizes = np.array([measure(ink, presses.grid) for ink in presses.ink])
    drawn = {tilt: np.array([_fitted(press, depth, tilt, presses.grid.x_mm) for depth in smooth]) for tilt in shown}
    figure, [axes] = picture_grid(1, 2, (9.6, 3.6), about(header)["label"])
    seen = {"length": sizes[:, 0] + sizes[:, 1], "width": sizes[:, 2]}
    for column, (axis, (what, measured)) in enumerate(zip(axes, seen.items(), strict=True)):
        for tilt, colour in zip(shown, COLOURS, strict=False):
            at = tilts == tilt
            axis.plot(depths[at], measured[at], "o", color=colour, alpha=0.6, markersize=4, label=f"α {tilt:g}°")
            axis.plot(smooth, drawn[tilt][:, column], color=colour, linewidth=1.5)
        axis.set(title=what, xlabel="commanded depth H, mm", ylabel=f"{what} of the mark, mm")
    return chart_uri(figure)


def _fitted(press: FittedPress, depth_mm: float, tilt_deg: float, x_mm: Floats) -> tuple[float, float]:
    """Length and width of the mark that is predicted, mm; NaN where there is none."""
    try:
        sizes = press.sizes(depth_mm, tilt_deg)
        half, _ = press.mark(depth_mm, tilt_deg, x_mm)
    except DomainError:
        return math.nan, math.nan
    return float(sizes.tip + sizes.heel), 2.0 * max(0.0, float(half.max()))


def _trust(result: FitResult) -> Iterator[Point]:
    csim = next((row.csim for row in result.held_out if row.model == FITTED), None)
    if csim is None or csim.below_ceiling is None:
        yield Point(None, "No combination was pressed twice, so the repeatability of the brush is not known here.")
    else:
        span = "" if csim.below_interval is None else " (95 % {:.1f} to {:.1f})".format(*csim.below_interval)
        words = f"On presses left out of it, the fit's CSIM is {csim.below_ceiling:.1f} points{span} below the ceiling"
        words += f", over the {csim.below_n} of {csim.n} presses with a ceiling" if csim.below_n < csim.n else ""
        yield Point(is_near(csim.below_ceiling, csim.below_interval), f"{words}; up to {NEAR_POINTS:g} points is near.")
    yield Point(None, "The pictures above show presses that were fitted; judge the fit by the held-out scores.")
