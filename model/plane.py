"""Stroke parameters as a plane over depth and tilt: the regression of `model.regression`, in numpy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Parameters as c0 + c1 H + c2 H alpha: `coefficients` (P, 3) for the P `names`."""

    names: tuple[str, ...]
    coefficients: NDArray[np.floating]

    def at(self, depth_mm: Any, tilt_deg: Any) -> dict[str, Any]:
        """The parameters at H and alpha: floats, arrays or tensors of one shape, which each parameter has too."""
        rows = zip(self.names, self.coefficients.tolist(), strict=True)
        return {name: a + depth_mm * (b + c * tilt_deg) for name, (a, b, c) in rows}


def fit_plane(depth_mm: ArrayLike, tilt_deg: ArrayLike, values: Mapping[str, ArrayLike]) -> Plane:
    """The least-squares fit to values (N,) at H and alpha (N,), for captures or marks alike.

    Raises ValueError if the cells do not span a plane: at least two depths and two tilts are needed.
    """
    height, tilt = np.asarray(depth_mm, np.float64), np.asarray(tilt_deg, np.float64)
    design = np.column_stack([np.ones_like(height), height, height * tilt])
    targets = np.column_stack([np.asarray(value, np.float64) for value in values.values()])
    coefficients, _, rank, _ = np.linalg.lstsq(design, targets)
    if rank < 3:
        raise ValueError(f"{len(design)} cells do not span depth and tilt: two depths and two tilts are needed")
    return Plane(tuple(values), coefficients.T)
