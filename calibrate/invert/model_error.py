"""Model error of recovered presses, estimated from how far presses of other cells lie from their commands.

The interval of one image says how well that image identifies a press within the model. How far the model and the
brush's own variation move a recovered value is seen only where the command is known: a variance that is common to the
presses, beside what each image's own interval explains. Each press takes it from the other cells of its session, so
that its own command does not enter its interval. A brush predicts the cells that it was fitted to better than others;
for a press of another cell it is estimated from such cells too, and the larger estimate counts.

R. C. Paule and J. Mandel, "Consensus values and weighting factors", Journal of Research of the National Bureau of
Standards 87 (1982), give the variance: with it, the mean of squared errors over their expected squares is 1.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.line import student_95

Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""
LEAST_CELLS = 3
"""With fewer other cells, the model error is unknown."""
NORMAL_95 = 1.96
ROUNDS = 100


def model_sd(off: Floats, sd: Floats, cells: list[Cell], fitted: Collection[Cell] = ()) -> Floats:
    """Standard deviation of the model error of N presses, (N,); NaN where too few other cells are known.

    `off` (N,) is recovered - commanded, NaN where no command is known; `sd` (N,) is the standard deviation from the
    image alone. `fitted` are the cells that the brush was fitted to. The result is enlarged by Student's t with a
    degree of freedom for each cell, so that 1.96 times it covers 95 % with few cells.
    """
    out = np.full(len(off), np.nan)
    known = np.isfinite(off) & np.isfinite(sd)
    for cell in set(cells):
        others = [k for k, other in enumerate(cells) if other != cell and known[k]]
        unseen = [] if cell in fitted else [k for k in others if cells[k] not in fitted]
        found = [_spread(off[k], sd[k], len({cells[at] for at in k})) for k in (others, unseen) if k]
        if len({cells[k] for k in others}) >= LEAST_CELLS:
            out[[k for k, other in enumerate(cells) if other == cell]] = max(found)
    return out


def common_variance(off: Floats, sd: Floats) -> float:
    """The variance v for which the mean of off^2 / (sd^2 + v) is 1; 0 where the deviations `sd` alone explain `off`.

    A press that its image hardly determines counts little, however large its deviation.
    """
    variance = 0.0
    square = np.maximum(sd**2, 1e-12)
    for _ in range(ROUNDS):  # Newton's method, which approaches the root of a convex function from below
        weight = 1.0 / (square + variance)
        excess = float(np.mean(off**2 * weight)) - 1.0
        if excess < 1e-9:
            break
        variance += excess / float(np.mean((off * weight) ** 2))
    return variance


def _spread(off: Floats, sd: Floats, cells: int) -> float:
    """The deviation from presses of so many cells, enlarged; 0 from too few."""
    if cells < LEAST_CELLS:
        return 0.0
    return math.sqrt(common_variance(off, sd)) * student_95(cells) / NORMAL_95
