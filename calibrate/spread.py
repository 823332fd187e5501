"""The order in which points are each as far as possible from those before: a maximin design that can stop anywhere.

After R. Kennard and L. Stone, "Computer aided design of experiments" (1969).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def farthest_first(places: NDArray[np.float64], first: int, count: int) -> list[int]:
    """Rows of (n, d) `places` in that order, from the row `first`; of equally distant ones the upper row comes first.

    Raises ValueError unless there are `count` rows, at least one.
    """
    if not 1 <= count <= len(places):
        raise ValueError(f"count = {count}: allowed 1 to {len(places)}")
    order, nearest = [first], np.full(len(places), np.inf)
    while len(order) < count:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[order[-1]], axis=1))
        nearest[order] = -1.0
        order.append(int(np.round(nearest, 9).argmax()))
    return order
