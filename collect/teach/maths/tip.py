"""The tip of the brush in the flange's frame, from flange poses at which it touched one and the same point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brushloop.calibrate.stats import student_95
from brushloop.collect.errors import CannotTeach
from brushloop.drivers.devices import Pose

Floats = NDArray[np.float64]
LEAST_TOUCHES = 4
WORST_CONDITION = 60.0
"""Above this the directions are so similar that errors of the touches appear many times larger in the length. If the
wrist turns along with the lean, all directions are the same: one side of the flange is always up."""
OUTLIER_SHARE = 4.0
"""A touch whose residual exceeds the others' standard deviation by this factor is named as a slip."""
LEAST_OUTLIER_MM = 1.0
ELSEWHERE_MM = 10.0
"""A touch that lies farther than this from where the others agree was not made at the pin."""
HAND_MM = 0.15
"""Smallest plausible error of a touch by hand, in one axis: a few touches may agree by chance."""
LEAST_OFF_DEG, LEAST_AGREEING = 1.0, 5
"""A hold that is less than this from the others is no stray, and fewer holds than this do not outvote a stray."""
MEDIAN_STEPS = 100


@dataclass(frozen=True, slots=True)
class TipFit:
    """Where the tip is, and how well that is known."""

    offset_mm: tuple[float, float, float]
    """Flange to tip, along the flange's axes."""
    pin_mm: tuple[float, float, float]
    """The point that was touched, in the base frame."""
    residuals_mm: tuple[float, ...]
    """Distance of the tip from the point in each touch."""
    sigma_mm: tuple[float, float, float]
    """Standard error of each component of the offset."""
    freedom: int
    """Degrees of freedom of the noise's estimate."""
    condition: float
    """Ratio of the largest to the smallest singular value of the equations."""

    @property
    def error_mm(self) -> float:
        """Root mean square of the distance by which the offset may be wrong."""
        return math.hypot(*self.sigma_mm)

    @property
    def reach_mm(self) -> float:
        """Half width of the 95 % interval of the worst component, by Student's t."""
        return student_95(self.freedom) * max(self.sigma_mm)

    def slip(self) -> tuple[int, float] | None:
        """Number of the touch that does not fit the others, and its residual in mm; None if all do."""
        worst = int(np.argmax(self.residuals_mm))
        others = [r for k, r in enumerate(self.residuals_mm) if k != worst]
        typical_mm = math.sqrt(sum(r * r for r in others) / len(others))
        limit_mm = max(LEAST_OUTLIER_MM, OUTLIER_SHARE * typical_mm)
        off_mm = self.residuals_mm[worst]
        return (worst, off_mm) if off_mm > limit_mm and len(others) >= LEAST_TOUCHES else None


def find_tip(flanges: Sequence[Pose]) -> TipFit:
    """Solve R_i t + p_i = c for the offset t and the point c by least squares (pivot calibration, e.g. Yaniv 2015).

    R_i and p_i are the poses of the flange. Raises `CannotTeach` for fewer than four touches, and for directions that
    are too alike.
    """
    if len(flanges) < LEAST_TOUCHES:
        raise CannotTeach(f"{len(flanges)} touches of the pin", f"do not give the tip: {LEAST_TOUCHES} are needed.")
    turns = np.array([Rotation.from_quat(pose.quaternion).as_matrix() for pose in flanges])
    places = np.array([pose.position_mm for pose in flanges])
    equations = np.concatenate([np.concatenate([turn, -np.eye(3)], axis=1) for turn in turns])
    _, sizes, _ = np.linalg.svd(equations, full_matrices=False)
    condition = float(sizes[0] / max(sizes[-1], 1e-12))
    if condition > WORST_CONDITION:
        raise CannotTeach(
            f"the touches of the pin are too alike (condition {condition:.0f}, limit {WORST_CONDITION:g}):",
            "lean the brush by 30 deg or more to all four sides, and do not turn the wrist along with it.",
        )
    found = np.asarray(np.linalg.lstsq(equations, -places.ravel(), rcond=None)[0], np.float64)
    off = (equations @ found + places.ravel()).reshape(-1, 3)
    freedom = 3 * len(flanges) - 6
    noise_mm = max(math.sqrt(float((off**2).sum()) / freedom), HAND_MM)
    spread = noise_mm * np.sqrt(np.diag(np.linalg.inv(equations.T @ equations)))
    return TipFit(
        _triple(found[:3]),
        _triple(found[3:]),
        tuple(float(r) for r in np.linalg.norm(off, axis=1)),
        _triple(spread[:3]),
        freedom,
        condition,
    )


def elsewhere(flanges: Sequence[Pose]) -> tuple[int, float] | None:
    """Number of the one touch that was made elsewhere, and its distance in mm from the point of the others.

    Such a touch spoils the residuals of all, so each touch is compared with a fit of the others alone. None if there
    is none, or for fewer than five touches.
    """
    worst, farthest_mm = None, ELSEWHERE_MM
    for k in range(len(flanges)):
        others = [pose for n, pose in enumerate(flanges) if n != k]
        try:
            fit = find_tip(others)
        except CannotTeach:
            continue
        off_mm = math.dist(tip_of(flanges[k], fit.offset_mm), fit.pin_mm)
        if off_mm > max(farthest_mm, 2.0 * OUTLIER_SHARE * max(fit.residuals_mm)):
            worst, farthest_mm = (k, off_mm), off_mm
    return worst


@dataclass(frozen=True, slots=True)
class AxisFit:
    """How the brush leans against the flange, from poses in which a person held it upright."""

    rotation_deg: tuple[float, float, float]
    """As `robot.tcp_rotation_deg`: about x, then y, then z of the flange."""
    lean_deg: float
    sigma_deg: float
    """Standard error of the lean in each direction; infinite for a single hold."""
    off_deg: tuple[float, ...]
    """Angle of each hold from the direction in which most of them agree."""
    strays: tuple[int, ...]
    """Numbers of the holds that do not agree with the others, and are not part of the fit."""

    @property
    def holds(self) -> int:
        """Number of holds that agree."""
        return len(self.off_deg) - len(self.strays)

    @property
    def clear(self) -> bool:
        """Whether so many holds agree that it is the strays which were not upright, and not the others."""
        return self.holds >= max(LEAST_AGREEING, 2 * len(self.strays))


def find_axis(flanges: Sequence[Pose]) -> AxisFit:
    """The brush's direction in the flange's frame: the mean of where "down" was, without the holds that stray.

    A hold strays if it is far from the geometric median of all, which a minority of bad holds hardly moves (Weiszfeld's
    iteration; Vardi and Zhang 2000). At least one pose.
    """
    down = np.array([Rotation.from_quat(p.quaternion).inv().apply([0.0, 0.0, -1.0]) for p in flanges])
    middle = down.mean(axis=0)
    for _ in range(MEDIAN_STEPS):
        weights = 1.0 / np.maximum(np.linalg.norm(down - middle, axis=1), 1e-6)
        middle = weights @ down / weights.sum()
    typical_deg = float(np.sort(_angles_deg(down, middle))[(len(down) - 1) // 2])
    agree = _angles_deg(down, middle) <= max(LEAST_OFF_DEG, OUTLIER_SHARE * typical_deg)
    mean = np.asarray(down[agree].mean(axis=0) / np.linalg.norm(down[agree].mean(axis=0)), np.float64)
    count, off_deg = int(agree.sum()), _angles_deg(down, mean)
    squares = float((off_deg[agree] ** 2).sum())
    sigma_deg = math.sqrt(squares / (2.0 * (count - 1)) / count) if count > 1 else math.inf
    across = np.cross([0.0, 0.0, 1.0], mean)
    lean = math.atan2(float(np.linalg.norm(across)), float(mean[2]))
    axis = across / max(float(np.linalg.norm(across)), 1e-12)
    rz, ry, rx = Rotation.from_rotvec(lean * axis).as_euler("ZYX", degrees=True)
    return AxisFit(
        (float(rx), float(ry), float(rz)),
        math.degrees(lean),
        sigma_deg,
        tuple(off_deg.tolist()),
        tuple(np.flatnonzero(~agree).tolist()),
    )


def _angles_deg(directions: Floats, toward: Floats) -> Floats:
    """(n,) angles between (n, 3) directions and one, of any lengths."""
    across = np.linalg.norm(np.cross(directions, toward), axis=1)
    return np.degrees(np.arctan2(across, directions @ toward))


def tip_of(flange: Pose, offset_mm: Sequence[float]) -> tuple[float, float, float]:
    """Where the tip is while the flange is there, in the base frame."""
    return _triple(np.array(flange.position_mm) + Rotation.from_quat(flange.quaternion).apply(offset_mm))


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
