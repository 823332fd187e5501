"""Model error of recovered presses, from how far those of other cells lie from their commands.

The interval of one image says how well that image identifies a press within the model. How far the model and the
brush's own variation move a recovered value is seen only where the command is known: the mean square of recovered -
commanded, less what the images' own intervals explain. Each press takes it from the other cells of its session, so that
its own command does not enter its interval.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Floats = NDArray[np.float64]
LEAST_CELLS = 3
"""With fewer other cells, the model error is unknown."""
NORMAL_95 = 1.96


def model_sd(off: Floats, sd: Floats, cells: list[tuple[float, float]]) -> Floats:
    """Standard deviation of the model error of N presses, (N,); NaN where too few other cells are known.

    `off` (N,) is recovered - commanded, NaN where no command is known, and `sd` (N,) that of the image alone. It is
    enlarged so that 1.96 of it hold 95 % with so few cells, by Student's t.
    """
    out = np.full(len(off), np.nan)
    for cell in set(cells):
        others = [k for k, other in enumerate(cells) if other != cell and np.isfinite(off[k]) and np.isfinite(sd[k])]
        count = len({cells[k] for k in others})
        if count >= LEAST_CELLS:
            excess = max(0.0, float(np.mean(off[others] ** 2 - sd[others] ** 2)))
            out[[k for k, other in enumerate(cells) if other == cell]] = np.sqrt(excess) * _few(count)
    return out


def _few(cells: int) -> float:
    return float(stdtrit(cells - 1, 0.975)) / NORMAL_95
