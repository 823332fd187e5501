"""Which press tells most about a brush, and when another would tell too little. No torch: a rig PC runs it.

With J the derivatives of a predicted image by the parameters, the presses done carry the Fisher information
sum J'J / noise, and the image of a cell is uncertain by tr(J'J C), C the inverse of information and prior. Half of that
over the ink's own square is the cosine similarity that is still to be won there. The edges' free terms are reckoned the
same way. The next press is the one after which the mean over all cells is least (V-optimal design: V. Fedorov, "Theory
of Optimal Experiments").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.fit.fit import EDGE_NOISE_MM, EDGE_SPREAD_MM, SPREAD_MM, Fit, Grid, jacobian
from model.fitted import MODES, NAMES, FittedPress, command_terms

Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""

NOISE = 1.0
"""Variance of a pixel of the edge times the number of pixels that stray together."""
ENOUGH_POINTS = 1.0
"""Stop when fewer points of CSIM (percent) than this are expected to be won by pressing on. About twice what really is:
the parameters' prior is wide."""


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
    # All parameters count, those too that a stage refused: what cannot be told yet is what a press is to tell.
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
