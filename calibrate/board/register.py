"""Register the robot to the paper, from marks that it touched or pressed and that the camera saw."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, rms
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.sessions.disk import number

Model = Literal["rigid", "similarity", "affine"]
COLUMNS = ("name", "robot_x_mm", "robot_y_mm", "image_x_px", "image_y_px")
LEAST_POINTS = {"rigid": 3, "similarity": 3, "affine": 4}
WORST_RMS_MM = 5.0
TRIALS = 500
OUTLIER_MEDIANS = 5.0
LEAST_OUTLIER_MM = 0.3
"""Marks that lie closer than this to the predicted place are never outliers."""
MIXED_UP_MM, EXPLAINED = 3.0, 0.2
"""A misfit is taken for mixed names only above this, and if they explain all but this share of it."""


@dataclass(frozen=True, slots=True)
class Registration:
    """The plane transformation from the robot's base frame to the paper frame, both in mm."""

    model: Model
    matrix: Floats
    """(2, 3)."""
    names: tuple[str, ...]
    residuals_mm: Floats
    """(n, 2) seen minus predicted, of every point including dropped ones."""
    dropped: tuple[str, ...]
    rms_mm: float
    left_out_mm: Floats
    """(n, 2) seen minus predicted by the other kept points."""

    @property
    def left_out_rms_mm(self) -> float:
        """Root mean square error of the kept points, each predicted by the others: what to expect of a new point."""
        kept = np.array([name not in self.dropped for name in self.names])
        return rms(self.left_out_mm[kept])

    @property
    def yaw_deg(self) -> float:
        """Yaw of the paper frame in the base frame, counter-clockwise from base x to paper x, as in `paper.yaw_deg`.

        The transformation from the base frame to the paper frame turns points the other way.
        """
        return float(np.degrees(np.arctan2(-self.matrix[1, 0], self.matrix[0, 0])))

    @property
    def origin_mm(self) -> tuple[float, float]:
        """Origin of the paper frame in the base frame, as in `paper.origin_mm`."""
        x, y = self.to_robot(np.zeros((1, 2)))[0]
        return float(x), float(y)

    @property
    def scale(self) -> float:
        """Paper mm per robot mm, the square root of the ratio of areas; 1 for a rigid transformation."""
        return float(np.sqrt(abs(np.linalg.det(self.matrix[:, :2]))))

    def to_paper(self, robot_mm: Floats) -> Floats:
        """(n, 2) points in the base frame -> in the paper frame."""
        return robot_mm @ self.matrix[:, :2].T + self.matrix[:, 2]

    def to_robot(self, paper_mm: Floats) -> Floats:
        """(n, 2) points in the paper frame -> in the base frame."""
        return (paper_mm - self.matrix[:, 2]) @ np.linalg.inv(self.matrix[:, :2]).T


def register(names: Sequence[str], robot_mm: Floats, seen_mm: Floats, model: Model = "rigid") -> Registration:
    """Fit by least squares to (n, 2) points of both frames, with outliers dropped and named (Umeyama 1991, eq. 40-43).

    Outliers are found by the few points (two, or three for an affine fit) that explain the others best. A similarity
    also fits the scale, for a board that was not printed at true scale; an affine fit treats x and y independently, for
    a page that was rectified to wrong proportions. Raises `CalibrationError` for fewer than three points, for points
    that are all in one place, and if most do not fit together.
    """
    where = f"{len(names)} points"
    if not len(names) == len(robot_mm) == len(seen_mm):
        raise ValueError(f"{len(names)} names, {len(robot_mm)} and {len(seen_mm)} points")
    least = LEAST_POINTS[model]
    if len(names) < least:
        raise CalibrationError(where, f"at least {least} are needed")
    if np.ptp(robot_mm, axis=0).max() < 1.0:
        raise CalibrationError(where, "lie within 1 mm: touch the paper at places far apart")
    if model == "rigid" and (problem := mixed_up(names, robot_mm, seen_mm)):
        raise CalibrationError(where, problem)
    kept = _agreeing(robot_mm, seen_mm, model)
    if kept.sum() < max(least, (len(names) + 1) // 2):
        raise CalibrationError(where, f"only {kept.sum()} agree: are their names mixed up?")
    matrix = _fit(robot_mm[kept], seen_mm[kept], model)
    residuals = seen_mm - _apply(matrix, robot_mm)
    if rms(residuals[kept]) > WORST_RMS_MM:
        problem = f"{rms(residuals[kept]):.1f} mm off on average, allowed {WORST_RMS_MM:g}: are their names mixed up?"
        raise CalibrationError(where, problem)
    left_out = residuals.copy()
    for index in np.flatnonzero(kept):
        others = kept.copy()
        others[index] = False
        left_out[index] = seen_mm[index] - _apply(_fit(robot_mm[others], seen_mm[others], model), robot_mm[[index]])[0]
    return Registration(
        model,
        matrix,
        tuple(names),
        residuals,
        tuple(name for name, keep in zip(names, kept, strict=True) if not keep),
        rms(residuals[kept]),
        left_out,
    )


def mixed_up(names: Sequence[str], robot_mm: Floats, seen_mm: Floats) -> str:
    """Why the points do not fit: a mirror, or two names that were exchanged; empty if they fit, or if nothing
    explains it.

    `robot_mm` and `seen_mm` are (n, 2). An explanation counts if it leaves a fifth of the largest misfit or less.
    """
    as_named = _worst(robot_mm, seen_mm)
    if as_named <= MIXED_UP_MM:
        return ""
    enough_mm = max(LEAST_OUTLIER_MM, EXPLAINED * as_named)
    if _worst(robot_mm * [1.0, -1.0], seen_mm) <= enough_mm:
        return (
            f"fit only as in a mirror (off by {as_named:.1f} mm otherwise): were they named from the other side, or is "
            "the photograph mirrored?"
        )
    found = list[tuple[float, str]]()
    for a, b in itertools.combinations(range(len(names)), 2):
        exchanged = robot_mm.copy()
        exchanged[[a, b]] = robot_mm[[b, a]]
        found.append((_worst(exchanged, seen_mm), f"{names[a]} and {names[b]}"))
    off_mm, pair = min(found)
    if off_mm > enough_mm:
        return ""
    return f"fit only if {pair} are swapped (off by {as_named:.1f} mm otherwise): one was touched in the other's place"


def _worst(robot_mm: Floats, seen_mm: Floats) -> float:
    """Largest distance that a rigid fit leaves."""
    off = seen_mm - _apply(_fit(robot_mm, seen_mm, "rigid"), robot_mm)
    return float(np.linalg.norm(off, axis=1).max())


def _agreeing(robot_mm: Floats, seen_mm: Floats, model: Model) -> NDArray[np.bool_]:
    best = np.full(len(robot_mm), np.inf)
    few = list(itertools.combinations(range(len(robot_mm)), 3 if model == "affine" else 2))
    for chosen in few[:: max(1, len(few) // TRIALS)]:
        points = robot_mm[list(chosen)]
        # Points on a line do not determine an affine map, points in one place determine nothing.
        if np.linalg.svd(points - points.mean(axis=0))[1][1 if model == "affine" else 0] < 1.0:
            continue
        away = np.linalg.norm(seen_mm - _apply(_fit(points, seen_mm[list(chosen)], model), robot_mm), axis=1)
        if np.median(away) < np.median(best):
            best = away
    if not np.isfinite(best).all():
        return np.zeros(len(robot_mm), np.bool_)
    rough = best <= max(LEAST_OUTLIER_MM, OUTLIER_MEDIANS * float(np.median(best)))
    # Judge again by the fit to all that agree: a fit to two or three points is inaccurate.
    away = np.linalg.norm(seen_mm - _apply(_fit(robot_mm[rough], seen_mm[rough], model), robot_mm), axis=1)
    return away <= max(LEAST_OUTLIER_MM, OUTLIER_MEDIANS * float(np.median(away)))


def _fit(robot_mm: Floats, seen_mm: Floats, model: Model) -> Floats:
    from_middle, to_middle = robot_mm.mean(axis=0), seen_mm.mean(axis=0)
    a, b = robot_mm - from_middle, seen_mm - to_middle
    if model == "affine":
        linear = np.asarray(np.linalg.pinv(a) @ b, np.float64).T
    else:
        u, s, vt = np.linalg.svd(b.T @ a)
        # Both frames are right-handed: a mirrored fit is never wanted.
        sign = np.array([1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
        linear = u @ np.diag(sign) @ vt
        if model == "similarity":
            linear = linear * float((s * sign).sum()) / max(float((a**2).sum()), 1e-12)
    return np.column_stack([linear, to_middle - linear @ from_middle])


def _apply(matrix: Floats, points: Floats) -> Floats:
    return points @ matrix[:, :2].T + matrix[:, 2]


@dataclass(frozen=True, slots=True)
class Points:
    """Points that the robot was commanded to, and where the camera saw them."""

    names: tuple[str, ...]
    robot_mm: Floats
    """(n, 2) in the base frame."""
    image_px: Floats
    """(n, 2) in the photograph as it was taken, pixel centres on integers."""
    sha256: str


def read_points(table: Path) -> Points:
    """Read a table with `COLUMNS`. Raises `CalibrationError` naming line and column."""
    data = read_bounded(table)
    try:
        rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(str(table), f"is not a CSV table in UTF-8: {error}") from None
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise CalibrationError(str(table), f"needs rows with the columns {', '.join(COLUMNS)}; missing: {missing[0]}")
    values = [[_number(table, line, name, row[name]) for name in COLUMNS[1:]] for line, row in enumerate(rows, start=2)]
    names = tuple(row["name"].strip() for row in rows)
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise CalibrationError(str(table), f"point {twice!r} appears twice")
    numbers = np.array(values)
    return Points(names, numbers[:, :2], numbers[:, 2:], hashlib.sha256(data).hexdigest())


def _number(table: Path, line: int, name: str, text: str | None) -> float:
    try:
        return number(text or "")
    except ValueError as error:
        raise CalibrationError(str(table), f"line {line}, column `{name}`: {error}") from None
