"""Choose the most informative next press from the ink of earlier presses. Runs on a rig PC, without torch.

Let J be the derivatives of a predicted image with respect to the parameters. The presses done carry the Fisher
information sum J'J / noise, and the uncertainty of a cell's image is tr(J'J C), with C the inverse of information plus
prior. Half of that, divided by the sum of squares of the ink, is the cosine similarity still to be gained in that cell.
The free terms of the edges are treated the same way. The next press is the one that minimises the expected mean over
all cells (V-optimal design: V. Fedorov, "Theory of Optimal Experiments"). Equal captures give equal choices.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.compare.field import SIZE_PX, Field
from calibrate.fit.fit import Fit, draw, fit_presses
from calibrate.fit.prior import learned
from calibrate.fit.strokes import SPREAD_MM, Grid, Pressed
from model.fitted import MODES, NAMES, FittedPress, command_terms

Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""

NOISE = 1.0
"""Variance of an edge pixel times the number of pixels whose errors are correlated."""
ENOUGH_POINTS = 1.0
"""Stop when fewer points of CSIM (percent) than this are expected from further presses. The expectation is about
twice the actual gain, because the parameters' prior is wide."""
FIELD = Field()
"""Field around the point of touch, the default of `brushloop fit`."""
REACH_MM = 12.0
"""Reach to either side of the axis: no press of the loopback rig's or the paper's brushes is wider."""
LEVELS = 15
EDGE_SPREAD_MM = (1.2, 0.4, 0.3, 0.15, 0.15, 0.15)
EDGE_NOISE_MM = 0.25
GIVEN_UP = 2
"""Number of captures without a whole stroke after which a cell is not chosen again."""


@dataclass(frozen=True, slots=True)
class CapturedPress:
    """One captured press."""

    height_mm: float
    tilt_deg: float
    ink: str
    """Ink as returned by `packed`; empty if the capture showed no whole stroke."""


@dataclass(frozen=True, slots=True)
class Design:
    """The candidate cells, and when to stop."""

    radius_mm: float
    length_mm: float
    cells: tuple[Cell, ...]
    enough_points: float
    least: int


@dataclass(frozen=True, slots=True)
class Next:
    """The chosen cell, and the fit that it is based on."""

    cell: Cell | None
    """Cell to press next; None to stop."""
    points: float
    """CSIM points still to be gained after the presses so far, mean over the cells."""
    points_after: float
    strokes: int
    """Number of captures in the fit."""
    ink_sha256: str
    """SHA-256 of their ink, in the order of the fit."""
    why: str


def packed(mask: NDArray[np.bool_]) -> str:
    """Encode a stroke on the field's raster (any even scale) as text: coverage per pixel in 16 steps, compressed."""
    ink = cv2.resize(mask.astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)[_rows()]
    return base64.b64encode(zlib.compress(np.round(LEVELS * ink).astype(np.uint8).tobytes(), 9)).decode()


def unpacked(text: str) -> NDArray[np.float64]:
    """Decode text from `packed` to coverage on the pixels of `field_grid`. Raises ValueError for anything else."""
    grid = field_grid()
    shape = len(grid.y_mm), len(grid.x_mm)
    try:
        data = zlib.decompressobj().decompress(base64.b64decode(text, validate=True), shape[0] * shape[1])
        return np.frombuffer(data, np.uint8).reshape(shape) / LEVELS
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"not the packed ink of a press: {error}") from None


def field_grid() -> Grid:
    """Pixel centres of packed ink, around the point of touch."""
    left, top = FIELD.anchor_mm
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * FIELD.mm_per_px, np.float64)
    return Grid(np.asarray(centres - left), np.asarray(top - centres)[_rows()])


def next_cell(design: Design, seen: Sequence[CapturedPress]) -> Next:
    """Fit the captured presses and choose the next cell. Takes a second or two on a slow core."""
    strokes = [Pressed(s.height_mm, s.tilt_deg, unpacked(s.ink)) for s in seen if s.ink]
    digest = hashlib.sha256("\n".join(s.ink for s in seen if s.ink).encode()).hexdigest()
    failed = [(s.height_mm, s.tilt_deg) for s in seen if not s.ink]
    left = [cell for cell in design.cells if failed.count(cell) < GIVEN_UP]
    if not left:
        why = "no cell is left whose captures show a whole stroke"
        return Next(None, 100.0, 100.0, len(strokes), digest, why)
    grid, brush = field_grid(), FittedPress(design.radius_mm, design.length_mm)
    if strokes:
        brush = fit_presses(strokes, grid, design.radius_mm, design.length_mm, residual=False).press
    done = [(s.height_mm, s.tilt_deg) for s in strokes]
    choice = next_press(brush, done, left, grid, enough_points=design.enough_points, least=design.least)
    points, after = min(choice.points, 100.0), min(choice.points_after, 100.0)
    why = (
        f"{points:.2f} points of CSIM are left to gain, at most {design.enough_points:g} are accepted"
        if choice.cell is None
        else f"{points:.2f} points of CSIM are left to gain, {after:.2f} after it"
    )
    return Next(choice.cell, points, after, len(strokes), digest, why)


@dataclass(frozen=True, slots=True)
class Choice:
    """The next cell to press, or the decision to stop."""

    cell: Cell | None
    """Cell to press; None to stop."""
    points: float
    """CSIM points still to be gained after the presses done, mean over the cells."""
    points_after: float
    """The same, as expected after the chosen press."""
    saved: int
    """Presses of the whole grid that are saved if `cell` is None; else 0."""


def next_press(
    fit: Fit | FittedPress,
    done: Sequence[Cell],
    candidates: Sequence[Cell],
    grid: Grid,
    *,
    enough_points: float = ENOUGH_POINTS,
    whole_grid: int = 0,
    least: int = 3,
) -> Choice:
    """Choose the most informative cell after the cells `done`, or stop. Pure: equal arguments give equal answers.

    Before the first press, pass `FittedPress(radius_mm, length_mm)`, the published brush. `whole_grid` is the number
    of presses in the grid. Raises ValueError without candidates.
    """
    if not candidates:
        raise ValueError("there is no cell to choose from")
    press = fit if isinstance(fit, FittedPress) else fit.press
    # Parameters that a stage refused count as well: the next press should determine them.
    views = {cell: _look(press, cell, grid) for cell in {*done, *candidates}}
    information = learned().precision + sum((views[cell].square for cell in done), np.zeros((len(NAMES), len(NAMES))))
    terms = _terms_information(done, views, grid)
    now = _points(information, terms, candidates, views, grid)
    after = [
        _points(information + views[c].square, terms + _terms_information([c], views, grid, prior=False), candidates,
                views, grid)
        for c in candidates
    ]  # fmt: skip
    best = int(np.argmin(after))
    if len(done) >= least and now <= enough_points:
        return Choice(None, now, now, max(0, whole_grid - len(done)))
    return Choice(candidates[best], now, after[best], 0)


@dataclass(frozen=True, slots=True)
class _View:
    square: Floats
    """J'J divided by the noise."""
    ink: float
    """Sum of squares of the image."""
    columns: float
    """Pixels along the mark."""
    terms: Floats


def _look(press: FittedPress, cell: Cell, grid: Grid) -> _View:
    drawn, sizes = draw(press, NAMES, *cell, grid), press.sizes(*cell)
    columns = float(sizes.tip + sizes.heel) / grid.px_mm
    ink = max(float(np.vdot(drawn.ink, drawn.ink)), 1.0)
    return _View(drawn.square() / NOISE, ink, columns, command_terms(*cell))


def _terms_information(cells: Sequence[Cell], views: dict[Cell, _View], grid: Grid, *, prior: bool = True) -> Floats:
    """(MODES, T, T) information on the edges' terms, mm^-2: a sine counts half of its columns."""
    out = np.zeros((MODES, len(EDGE_SPREAD_MM), len(EDGE_SPREAD_MM)))
    if prior:
        for k in range(MODES):
            out[k] += np.diag(((k + 1) / np.array(EDGE_SPREAD_MM)) ** 2)
    for cell in cells:
        view = views[cell]
        # Errors of neighbouring columns are correlated over about 3 mm.
        independent = view.columns * grid.px_mm / 3.0
        out += 0.5 * independent / EDGE_NOISE_MM**2 * np.outer(view.terms, view.terms)
    return out


def _points(information: Floats, terms: Floats, cells: Sequence[Cell], views: dict[Cell, _View], grid: Grid) -> float:
    covariance, edges = np.linalg.inv(information), np.linalg.inv(terms)
    # Moving an edge by d changes the sum of squares of a column's logistic by d^2 / (6 spread) per mm.
    per_mm2 = 1.0 / (6.0 * SPREAD_MM * grid.px_mm)
    losses: list[float] = []
    for cell in cells:
        view = views[cell]
        strays = float(np.einsum("t,mts,s->", view.terms, edges, view.terms)) * 0.5 * view.columns
        losses.append(0.5 * (NOISE * float((covariance * view.square).sum()) + 2.0 * strays * per_mm2) / view.ink)
    return 100.0 * float(np.mean(losses))


def _rows() -> slice:
    middle, reach = FIELD.anchor_mm[1] / FIELD.mm_per_px, REACH_MM / FIELD.mm_per_px
    return slice(round(middle - reach), round(middle + reach))
