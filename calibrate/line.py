"""A straight line by least squares with the interval of its slope, and Student's factor for any interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


def student_95(freedom: int) -> float:
    """Half width of a 95 % interval in standard errors that were estimated with so many degrees of freedom."""
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, 0.975))


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
        reach = student_95(self.n - 2) * self.slope_se
        return self.slope - reach, self.slope + reach


def fit_line(x: Sequence[float], y: Sequence[float], weights: Sequence[float] | None = None) -> Line | None:
    """y = slope x + intercept; None with fewer than 3 points or no spread in x or y.

    Points may have positive `weights`, inversely proportional to their variances.
    """
    n = len(x)
    if n < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    share = np.ones(n) if weights is None else np.asarray(weights, np.float64)
    x_mean, y_mean = float(np.average(x, weights=share)), float(np.average(y, weights=share))
    xs, ys = np.asarray(x) - x_mean, np.asarray(y) - y_mean
    sxx, sxy, syy = (float((share * a * b).sum()) for a, b in ((xs, xs), (xs, ys), (ys, ys)))
    slope = sxy / sxx
    residual = ys - slope * xs
    slope_se = float(np.sqrt((share * residual**2).sum() / max(n - 2, 1) / sxx))
    return Line(slope, y_mean - slope * x_mean, slope_se, sxy / float(np.sqrt(sxx * syy)), n)
