"""`brushloop fit SESSION` for presses as a function: the fitted brush of a session, its files and its tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.artefact import load_artefact, put_to_use
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.fit.artefact import FOLDER, BrushFit
from brushloop.calibrate.fit.captures import Captures, read_presses
from brushloop.calibrate.fit.report import write_fit_page
from brushloop.calibrate.fit.run import Correction, Fitted, correction, fit_session
from brushloop.calibrate.fit.sizes import FEWEST_CELLS, middle
from brushloop.calibrate.report import framed, source_label, source_note
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen


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
class FitResult:
    """The fitted brush that a session uses from now on."""

    fit: BrushFit
    path: Path
    page: Path
    captures: Captures
    fitted: Fitted
    correction: Correction | None

    def lines(self) -> Iterator[object]:
        """What the command prints: lines and tables."""
        yield from _tables(self.captures, self.fitted)
        if self.correction is not None:
            yield from _correction(self.correction)
        yield f"Fit: {self.path}"
        yield f"Page: {self.page}"

    def _repr_html_(self) -> str:
        return framed(self.page)


def fit_presses(request: FitRequest, progress: Progress = unseen) -> FitResult:
    """Fit the brush to the presses of a session, put the fit to use and write its page. Raises `CalibrationError`."""
    before = load_artefact(request.reference, BrushFit) if request.reference is not None else None
    view = Field(mm_per_px=request.mm_per_px)
    captures = read_presses(request.session, view, request.calibration, progress)
    fitted = fit_session(captures, view, progress)
    path = put_to_use(fitted.artefact, Recording(request.session).path.parent, FOLDER)
    moved = correction(captures, before) if before is not None else None
    return FitResult(fitted.artefact, path, write_fit_page(captures, fitted, path), captures, fitted, moved)


def _tables(captures: Captures, fitted: Fitted) -> Iterator[object]:
    from rich.table import Table

    yield f"{source_note(captures.header.source, captures.header.brush)}; {len(captures.strokes)} presses fitted"
    for name, why in captures.refused:
        yield f"left out: {name}: {why}"
    label = source_label(captures.header.source, [captures.header.brush])
    out = Table(
        "size, mm",
        "at {:g} mm, {:g}°".format(*middle(captures.strokes)),
        "per mm of depth",
        "per degree of tilt",
        title=f"sizes of the marks with 95 % intervals ({label})",
    )
    for size in fitted.sizes:
        out.add_row(size.name, str(size.here), str(size.by_depth), str(size.by_tilt))
    yield (
        out
        if fitted.sizes
        else f"Intervals of the sizes of the marks need {FEWEST_CELLS} combinations of depth and tilt."
    )
    if not fitted.held_out:
        yield "Only one cell: nothing can be held out."
        return
    out = Table("model", "n", "CSIM", "SSIM", title=f"leave one cell out, mm, binary, percent ({label})")
    for row in fitted.held_out:
        out.add_row(row.model, str(row.n), f"{row.csim:.2f}", f"{row.ssim:.2f}")
    yield out


def _correction(found: Correction) -> Iterator[str]:
    yield f"Zero touch relative to the fit of {found.reference}, with all else of the brush held:"
    yield f"  paper.touch_z_mm: add {found.lift_mm} mm, 95 % interval in brackets"
    yield f"  along the heading: the ink is off by {found.along_mm} mm"
    if found.lift_mm.low <= 0.0 <= found.lift_mm.high:
        yield "  The interval includes 0: leave rig.toml as it is."
