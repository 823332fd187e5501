"""Contacts of brush and paper, each from touch to lift-off, and the wrench on the force sensor meanwhile."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.devices import Pose
from brushloop.drivers.force.rounds import Wrench
from brushloop.drivers.geometry import columns, interpolate, lean, of_vector, product, unit
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec

SIDEWAYS_MM = 0.5
"""A contact that travels less far sideways is a press."""


@dataclass(frozen=True, slots=True)
class Contact:
    """The path of the tip at and below the paper plane; straight lines between poses."""

    poses: tuple[Pose, ...]
    deepest: Pose
    """The pose farthest below the plane; the first if there are several."""

    @property
    def dragged(self) -> bool:
        """False for a press. Withdrawing along the brush's own axis is not a drag, even if it is tilted."""
        return sum(_sideways_mm(a, b) for a, b in itertools.pairwise(self.poses)) > SIDEWAYS_MM


class ContactWatch:
    """Collects finished stretches of the path until the brush lifts off the paper.

    `above_mm` is the distance of a pose from the paper plane, negative below; it is linear in the position.
    """

    def __init__(self, above_mm: Callable[[Pose], float]) -> None:
        self._above_mm = above_mm
        self._poses: list[Pose] = []

    def travelled(self, start: Pose, end: Pose) -> Contact | None:
        """Add one straight stretch; return the contact that it ended, or None."""
        high, low = self._above_mm(start), self._above_mm(end)
        if high < 0.0 or low < 0.0:
            if not self._poses:
                self._poses.append(start if high < 0.0 else interpolate(start, end, high / (high - low)))
            self._poses.append(end if low < 0.0 else interpolate(start, end, high / (high - low)))
        if low < 0.0 or not self._poses:
            return None
        contact = Contact(tuple(self._poses), min(self._poses, key=self._above_mm))
        self._poses = []
        return contact


def _sideways_mm(a: Pose, b: Pose) -> float:
    """Travel along the paper or across the brush's axis, whichever is shorter."""
    way = np.subtract(b.position_mm, a.position_mm)
    axis = np.array(columns(unit(b.quaternion))[2])
    return min(math.hypot(way[0], way[1]), float(np.linalg.norm(way - (way @ axis) * axis)))


TILTS_DEG = (0.0, 7.5, 15.0, 30.0)
"""Tilts for which the push is solved; between them it is interpolated."""
GRAVITY_M_S2 = 9.81
ALONG_RAD = 1e-6
LEVEL = (0.0, 0.0, 1.0)


class Reaction:
    """The wrench for a pose of the tip above or in the paper.

    The push comes from the same spine as the ink, on the way down. Friction along the paper, the pull of the menisci
    and the hysteresis on the way up are left out: only the normal force of a press remains.
    """

    def __init__(self, brush: Brush, *, sensor_to_tip_mm: float, hanging_kg: float) -> None:
        self._brush = brush
        self._arm_m = sensor_to_tip_mm / 1e3
        self._weight_n = hanging_kg * GRAVITY_M_S2
        self._table: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def prepare(self) -> None:
        """Solve the spines; takes some tenths of a second, so call it outside the event loop. Once is enough."""
        if self._table is not None:
            return
        self._table = _pushes(self._brush.spec)

    def push_n(self, depth_mm: float, tilt_deg: float) -> float:
        """Normal force of the paper on the bundle; 0 in the air."""
        if depth_mm <= 0.0:
            return 0.0
        self.prepare()
        assert self._table is not None
        steps_mm, rows = self._table
        at_tilts = np.array([np.interp(depth_mm, steps_mm, rows[k]) for k in range(len(TILTS_DEG))], np.float64)
        return float(np.interp(tilt_deg, np.array(TILTS_DEG), at_tilts))

    def wrench(
        self,
        tip: Pose,
        depth_mm: float,
        normal: tuple[float, float, float] = LEVEL,
        finger_n: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Wrench:
        """Force in N and torque in Nm on the sensor, in the tool's frame: z along the tool, towards the tip.

        `normal` is the unit vector out of the paper, `finger_n` a person's push on the tip, both in the base frame.
        """
        push_n = self.push_n(depth_mm, lean(leaning_with(tip, normal))[0])
        push, weight_n = (push_n * part for part in normal), (0.0, 0.0, self._weight_n)
        force_n = [a - b + c for a, b, c in zip(push, weight_n, finger_n, strict=True)]
        axes = columns(unit(tip.quaternion))
        fx, fy, fz = (x * force_n[0] + y * force_n[1] + z * force_n[2] for x, y, z in axes)
        return fx, fy, fz, -self._arm_m * fy, self._arm_m * fx, 0.0


def leaning_with(pose: Pose, normal: tuple[float, float, float]) -> Pose:
    """The pose in a frame whose z is the paper's normal, rotated from the base frame by the least angle."""
    if normal == LEVEL:
        return pose
    nx, ny, nz = normal
    share = math.acos(nz) / math.hypot(nx, ny)  # of (ny, -nx, 0), the cross product of the normal and the level one
    level = of_vector((share * ny, share * -nx, 0.0))
    return Pose(*pose.position_mm, *product(level, unit(pose.quaternion)))


def bent_toward(pose: Pose, tilt_deg: float, heading_deg: float, set_lean_deg: float) -> float:
    """Direction into which the bundle bends: that of the lean, and for a brush almost upright that of its own set.

    The paper pushes at the tip, so the bundle bends to where its tip lies beside the ferrule's axis. The lean carries
    the tip toward `heading_deg`, and the set of hair that has been pressed carries it along the wrist's x as far as a
    lean of `set_lean_deg` would. Without the set, a brush that leans by a tenth of a degree would bend into any
    direction.
    """
    along, _, _ = columns(unit(pose.quaternion))
    wrist_deg = math.degrees(math.atan2(along[1], along[0]))
    off = math.radians(math.remainder(heading_deg - wrist_deg, 360.0))
    if abs(off) < ALONG_RAD:
        return heading_deg
    return wrist_deg + math.degrees(math.atan2(tilt_deg * math.sin(off), tilt_deg * math.cos(off) + set_lean_deg))


@functools.lru_cache(maxsize=8)
def _pushes(spec: BrushSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths (n,) in mm and the normal force (tilts, n) in N at each."""
    brush = Brush(spec)
    depth_mm = brush.deepest_mm(TILTS_DEG[-1])
    rows = [brush.push_n(depth_mm, tilt_deg) for tilt_deg in TILTS_DEG]
    return np.linspace(0.0, depth_mm, rows[0].size), np.asarray(rows)
