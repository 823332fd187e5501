"""A straight line by least squares, with the interval of its slope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Line:
    """A fitted line, with the standard error of its slope."""

    slope: float
    intercept: float
    slope_se: float
    r: float
    n: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the slope (Student's t with n - 2 degrees of freedom)."""
        from scipy.special import stdtrit  # slow to import

        reach = float(stdtrit(self.n - 2, 0.975)) * self.slope_se
        return self.slope - reach, self.slope + reach


def fit_line(x: Sequence[float], y: Sequence[float]) -> Line | None:
    """y = slope x + intercept; None with fewer than 3 points or no spread in x or y."""
    n = len(x)
    if n < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    xs, ys = np.asarray(x), np.asarray(y)
    sxx = float(((xs - xs.mean()) ** 2).sum())
    slope = float(((xs - xs.mean()) * (ys - ys.mean())).sum()) / sxx
    intercept = float(ys.mean()) - slope * float(xs.mean())
    residual = ys - slope * xs - intercept
    slope_se = float(np.sqrt((residual**2).sum() / max(n - 2, 1) / sxx))
    return Line(slope, intercept, slope_se, float(np.corrcoef(xs, ys)[0, 1]), n)
