"""Levenberg-Marquardt for costs whose normal equations are summed pixel by pixel, with feasible steps only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e4
FLOOR = 1e-3
"""Added to the diagonal before damping, so that a variable without any influence is damped as well."""


@dataclass(frozen=True, slots=True)
class Equations:
    """A cost at some vector, with J'J and the gradient J'r there."""

    cost: float
    square: Floats
    gradient: Floats


def descend(
    equations: Callable[[Floats], Equations],
    start: Floats,
    *,
    rounds: int,
    most: float,
    gain: float,
    cost: Callable[[Floats], float] | None = None,
    feasible: Callable[[Floats], Floats] | None = None,
) -> Floats:
    """Lower a cost from `start` in at most `rounds` trials; a step changes no variable by more than `most`.

    Stops when a step lowers the cost by less than the share `gain`. `feasible` maps a trial to the nearest vector that
    is allowed. `cost` gives the cost alone where that is cheaper than `equations`.
    """
    value = cost or (lambda vector: equations(vector).cost)
    vector, damping = start, 1e-1
    at = equations(vector)
    for _ in range(rounds):
        damped = at.square + damping * np.diag(np.diag(at.square) + FLOOR)
        trial = vector + np.clip(np.linalg.solve(damped, -at.gradient), -most, most)
        trial = trial if feasible is None else feasible(trial)
        found = value(trial)
        if found < at.cost:
            gained = (at.cost - found) / at.cost
            vector, damping = trial, max(damping / 4.0, LEAST_DAMPING)
            at = equations(vector)
            if gained < gain:
                break
        else:
            damping *= 5.0
            if damping > MOST_DAMPING:
                break
    return vector
