"""Choose the press that tells most about a brush from the ink of the presses before. No torch: a rig PC runs it.

With J the derivatives of a predicted image by the parameters, the presses done carry the Fisher information
sum J'J / noise, and the image of a cell is uncertain by tr(J'J C), C the inverse of information and prior. Half of that
over the ink's own square is the cosine similarity that is still to be won there. The edges' free terms are treated
the same way. The next press is the one after which the mean over all cells is least (V-optimal design: V. Fedorov,
"Theory of Optimal Experiments"). The same captures give the same choice, in every process.
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
from calibrate.fit.fit import EDGE_NOISE_MM, EDGE_SPREAD_MM, SPREAD_MM, Fit, Grid, Pressed, fit_presses, jacobian
from model.fitted import MODES, NAMES, FittedPress, command_terms

Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""

NOISE = 1.0
"""Variance of a pixel of the edge times the number of pixels that stray together."""
ENOUGH_POINTS = 1.0
"""Stop when fewer points of CSIM (percent) than this are expected to be won by pressing on. The expectation is about
twice the actual gain: the parameters' prior is wide."""
FIELD = Field()
"""Around the point of touch, as `brushloop fit` has it by default."""
REACH_MM = 12.0
"""To either side of the axis: no press of a brush that the loopback rig or the paper has is wider."""
LEVELS = 15
GIVEN_UP = 2
"""A cell whose captures showed no whole stroke so often is not chosen again."""


@dataclass(frozen=True, slots=True)
class CapturedPress:
    """One captured press."""

    height_mm: float
    tilt_deg: float
    ink: str
    """Of `packed`; empty where the capture showed no whole stroke."""


@dataclass(frozen=True, slots=True)
class Design:
    """What can be chosen, and when to stop."""

    radius_mm: float
    length_mm: float
    cells: tuple[Cell, ...]
    enough_points: float
    least: int


@dataclass(frozen=True, slots=True)
class Next:
    """The choice."""

    cell: Cell | None
    """None: stop."""
    points: float
    """CSIM points, in the mean over the cells, that the presses so far leave to be won."""
    points_after: float
    strokes: int
    """Captures that the fit was made of."""
    ink_sha256: str
    """Of their ink, in the order of the fit."""
    why: str


def packed(mask: NDArray[np.bool_]) -> str:
    """A stroke on the field's raster (any even scale) as text: coverage of each pixel in 16 steps, compressed."""
    ink = cv2.resize(mask.astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)[_rows()]
    return base64.b64encode(zlib.compress(np.round(LEVELS * ink).astype(np.uint8).tobytes(), 9)).decode()


def unpacked(text: str) -> NDArray[np.float64]:
    """The inverse: coverage on the pixels of `field_grid`. Raises ValueError for anything else."""
    grid = field_grid()
    shape = len(grid.y_mm), len(grid.x_mm)
    try:
        data = zlib.decompressobj().decompress(base64.b64decode(text, validate=True), shape[0] * shape[1])
        return np.frombuffer(data, np.uint8).reshape(shape) / LEVELS
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"no ink of a press: {error}") from None


def field_grid() -> Grid:
    """Pixel centres of packed ink around the point of touch."""
    left, top = FIELD.anchor_mm
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * FIELD.mm_per_px, np.float64)
    return Grid(np.asarray(centres - left), np.asarray(top - centres)[_rows()])


def next_cell(design: Design, seen: Sequence[CapturedPress]) -> Next:
    """Fit what is seen, and choose. A second or two on a slow core."""
    strokes = [Pressed(s.height_mm, s.tilt_deg, unpacked(s.ink)) for s in seen if s.ink]
    digest = hashlib.sha256("\n".join(s.ink for s in seen if s.ink).encode()).hexdigest()
    failed = [(s.height_mm, s.tilt_deg) for s in seen if not s.ink]
    left = [cell for cell in design.cells if failed.count(cell) < GIVEN_UP]
    if not left:
        why = "no cell is left whose captures show a whole stroke"
        return Next(None, 100.0, 100.0, len(strokes), digest, why)
    grid, brush = field_grid(), FittedPress(design.radius_mm, design.length_mm)
    if strokes:
        brush = fit_presses(strokes, grid, design.radius_mm, design.length_mm, edges=False).press
    done = [(s.height_mm, s.tilt_deg) for s in strokes]
    choice = next_press(brush, done, left, grid, enough_points=design.enough_points, least=design.least)
    points, after = min(choice.points, 100.0), min(choice.points_after, 100.0)
    why = (
        f"{points:.2f} points of CSIM are left to be won, at most {design.enough_points:g} were to be"
        if choice.cell is None
        else f"{points:.2f} points of CSIM are left to be won, {after:.2f} after it"
    )
    return Next(choice.cell, points, after, len(strokes), digest, why)


@dataclass(frozen=True, slots=True)
class Choice:
    """What to do next."""

    cell: Cell | None
    """Where to press; None: stop."""
    points: float
    """CSIM points, in the mean over the cells, that the presses done leave to be won."""
    points_after: float
    """The same, expected after the press."""
    saved: int
    """Presses of the whole grid that need not be made, where `cell` is None; else 0."""


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
    """The cell that tells most after the cells `done`, or to stop. Pure: equal arguments, equal answer.

    Before the first press give `FittedPress(radius_mm, length_mm)`, the published brush. `whole_grid` is how many
    presses the grid has. Raises ValueError without candidates.
    """
    if not candidates:
        raise ValueError("there is no cell to choose from")
    press = fit if isinstance(fit, FittedPress) else fit.press
    # All parameters count, also those that a stage refused: the next press is to determine them.
    views = {cell: _look(press, cell, grid) for cell in {*done, *candidates}}
    information = np.eye(len(NAMES)) + sum((views[cell].square for cell in done), np.zeros((len(NAMES), len(NAMES))))
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
    """J'J over the noise."""
    ink: float
    """Sum of squares of the image."""
    columns: float
    """Pixels along the mark."""
    terms: Floats


def _look(press: FittedPress, cell: Cell, grid: Grid) -> _View:
    seen, slopes = jacobian(press, NAMES, *cell, grid)
    sizes = press.sizes(*cell)
    columns = (sizes.tip + sizes.heel) / grid.px_mm
    return _View(slopes.T @ slopes / NOISE, max(float(seen @ seen), 1.0), columns, command_terms(*cell))


def _terms_information(cells: Sequence[Cell], views: dict[Cell, _View], grid: Grid, *, prior: bool = True) -> Floats:
    """(MODES, T, T) information on the edges' terms, mm^-2: a sine has half its columns' worth."""
    out = np.zeros((MODES, len(EDGE_SPREAD_MM), len(EDGE_SPREAD_MM)))
    if prior:
        for k in range(MODES):
            out[k] += np.diag(((k + 1) / np.array(EDGE_SPREAD_MM)) ** 2)
    for cell in cells:
        view = views[cell]
        # Neighbouring columns stray together: over about 3 mm.
        independent = view.columns * grid.px_mm / 3.0
        out += 0.5 * independent / EDGE_NOISE_MM**2 * np.outer(view.terms, view.terms)
    return out


def _points(information: Floats, terms: Floats, cells: Sequence[Cell], views: dict[Cell, _View], grid: Grid) -> float:
    covariance, edges = np.linalg.inv(information), np.linalg.inv(terms)
    # An edge off by d changes a column's logistic by d^2 / (6 spread) in sum of squares per mm.
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
