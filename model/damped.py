"""Levenberg-Marquardt (1944, 1963) for costs whose normal equations are summed pixel by pixel, feasible steps only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Equations:
    """A cost at some vector, with J'J and the gradient J'r there."""

    cost: float
    square: Floats
    gradient: Floats


@dataclass(frozen=True, slots=True)
class Damping:
    """How the damping changes: divided by `shrink` after a step that lowers the cost, else multiplied by `grow`."""

    first: float = 1e-1
    shrink: float = 4.0
    grow: float = 5.0
    least: float = 1e-4
    most: float = 1e4
    """With more than this, the descent ends."""
    floor: float = 1e-3
    """Added to the diagonal before damping, so that a variable without any influence is damped as well."""


USUAL = Damping()


@dataclass(frozen=True, slots=True)
class Lowest:
    """Where a descent ended, and the equations there."""

    vector: Floats
    at: Equations


def descend(
    equations: Callable[[Floats], Equations],
    start: Floats,
    *,
    rounds: int,
    most: float,
    gain: float,
    scale: Floats | float = 1.0,
    damping: Damping = USUAL,
    cost: Callable[[Floats], float] | None = None,
    feasible: Callable[[Floats], Floats | None] | None = None,
) -> Lowest:
    """Lower a cost from `start` in at most `rounds` trials.

    The equations are those of the variables divided by `scale`; no step changes one of them by more than `most`. Stops
    when a step lowers the cost by less than the share `gain` of its size. `feasible` maps a trial to the nearest vector
    that is allowed, or to None if there is none, which counts as a failed step. `cost` gives the cost alone where that
    is cheaper than `equations`.
    """
    vector, damped_by = start, damping.first
    at = equations(vector)
    for _ in range(rounds):
        damped = at.square + damped_by * np.diag(np.diag(at.square) + damping.floor)
        trial = vector + scale * np.clip(np.linalg.solve(damped, -at.gradient), -most, most)
        allowed = trial if feasible is None else feasible(trial)
        if allowed is None:
            damped_by *= damping.grow
            continue
        there = equations(allowed) if cost is None else Equations(cost(allowed), at.square, at.gradient)
        if there.cost < at.cost:
            little = at.cost - there.cost < gain * abs(at.cost)
            vector, damped_by = allowed, max(damped_by / damping.shrink, damping.least)
            at = there if cost is None else equations(vector)
            if little:
                break
        else:
            damped_by *= damping.grow
            if damped_by > damping.most:
                break
    return Lowest(vector, at)
