"""Which cells of a grid to press: the rules that `bench adaptive` compares.

Let J be the derivatives of a cell's predicted image by the parameters of the brush. A press of the cell adds J'J to the
Fisher information, less what the strays of single presses (`calibrate.fit.fit.STRAYS`) take away. Information and prior
give a covariance C, and tr(J'J C) is the expected squared error of that cell's image. Half of that over the sum of
squares of the ink is the cosine similarity still to be gained there. The residual's edges are treated in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.brushfit_presses import CELLS
from calibrate.fit.captures import SPREAD_MM, Grid
from calibrate.fit.fit import STRAYS, draw
from calibrate.fit.prior import Prior
from model.fitted import MODES, NAMES, PARAMETERS, FittedPress, command_terms

Floats = NDArray[np.float64]
EDGE_SPREAD_MM = (1.2, 0.4, 0.3, 0.15, 0.15, 0.15)
"""Standard deviation of an edge's terms before the first press, for the first sine; it falls as one over the number."""
EDGE_NOISE_MM, CORRELATED_MM = 0.25, 3.0
"""Standard deviation of an edge from press to press, and the length over which its errors are correlated."""
STRAY = [NAMES.index(name) for name in STRAYS]


@dataclass(frozen=True, slots=True)
class Looks:
    """What a press of each cell would show of a brush."""

    square: Floats
    """(cells, P, P): J'J of a cell's image."""
    known: Floats
    """(cells, P, P): the information of one press of it."""
    ink: Floats
    """(cells,): sum of squares of the image."""
    columns: Floats
    """(cells,): pixels along the mark."""
    terms: Floats
    """(cells, T): terms of the residual."""
    px_mm: float

    @classmethod
    def of(cls, press: FittedPress, grid: Grid) -> Looks:
        """Look at every cell of `CELLS`."""
        drawn = [draw(press, NAMES, *cell, grid) for cell in CELLS]
        square = np.array([one.square() for one in drawn])
        stiff = np.diag([(STRAYS[NAMES[k]] / PARAMETERS[k].spread) ** -2.0 for k in STRAY])
        taken = np.linalg.inv(square[:, STRAY][:, :, STRAY] + stiff) @ square[:, STRAY]
        sizes = [press.sizes(*cell) for cell in CELLS]
        return cls(
            square,
            square - square[:, :, STRAY] @ taken,
            np.array([max(float(np.vdot(one.ink, one.ink)), 1.0) for one in drawn]),
            np.array([float(size.tip + size.heel) / grid.px_mm for size in sizes]),
            np.array([command_terms(*cell) for cell in CELLS]),
            grid.px_mm,
        )


def most_useful(press: FittedPress, prior: Prior, done: Sequence[int], grid: Grid) -> int:
    """The cell after whose press the images of all cells are least uncertain, as the fit `press` expects.

    V-optimal design: V. Fedorov, "Theory of Optimal Experiments", 1972.
    """
    looks = Looks.of(press, grid)
    chosen = list(done)
    after = [_points(looks, prior, [*chosen, cell]) for cell in range(len(CELLS))]
    return int(np.argmin(after))


def d_optimal(prior: Prior, radius_mm: float, length_mm: float, grid: Grid, presses: int) -> list[int]:
    """A fixed order of cells: each makes the determinant of information and prior largest, for the prior's mean brush.

    The greedy form of D-optimal design: J. Kiefer and J. Wolfowitz, "Optimum designs in regression problems", 1959.
    """
    looks = Looks.of(FittedPress(radius_mm, length_mm, prior.values), grid)
    order: list[int] = []
    information = prior.precision
    for _ in range(presses):
        order.append(int(np.argmax(np.linalg.slogdet(information + looks.known)[1])))
        information = information + looks.known[order[-1]]
    return order


def _points(looks: Looks, prior: Prior, done: Sequence[int]) -> float:
    """CSIM points still to be gained after these presses, mean over the cells."""
    covariance = np.linalg.inv(prior.precision + looks.known[list(done)].sum(axis=0))
    along = 0.5 * looks.columns * looks.px_mm / CORRELATED_MM / EDGE_NOISE_MM**2
    seen = np.einsum("c,ct,cs->ts", along[list(done)], looks.terms[list(done)], looks.terms[list(done)])
    before = [np.diag(((k + 1) / np.array(EDGE_SPREAD_MM)) ** 2) for k in range(MODES)]
    edges = np.linalg.inv(np.array(before) + seen).sum(axis=0)
    # Moving an edge by d changes the sum of squares of a column's logistic by d^2 / (6 spread) per mm.
    wavy = np.einsum("ct,ts,cs->c", looks.terms, edges, looks.terms) * looks.columns / (6.0 * SPREAD_MM * looks.px_mm)
    shape = np.einsum("cpq,pq->c", looks.square, covariance)
    return 100.0 * float(np.mean(0.5 * (shape + wavy) / looks.ink))
