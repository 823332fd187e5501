"""One contact of brush and paper, from touching to lifting off, from the path of the tip."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.geometry import interpolate
from drivers.samples import Pose

SIDEWAYS_MM = 0.5
"""A contact that travels less far sideways is a press."""


@dataclass(frozen=True, slots=True)
class Contact:
    """The path of the tip at and below the paper plane; straight lines between poses."""

    poses: tuple[Pose, ...]
    deepest: Pose
    """The first of those farthest below the plane."""

    @property
    def dragged(self) -> bool:
        """False for a press. Withdrawing along the brush's own axis is no drag, be it tilted."""
        return sum(_sideways_mm(a, b) for a, b in itertools.pairwise(self.poses)) > SIDEWAYS_MM


class ContactWatch:
    """Collects finished stretches of the path until the brush lifts off the paper.

    `above_mm` is the distance of a pose from the paper plane, negative below; it is linear in the position.
    """

    def __init__(self, above_mm: Callable[[Pose], float]) -> None:
        self._above_mm = above_mm
        self._poses: list[Pose] = []

    def travelled(self, start: Pose, end: Pose) -> Contact | None:
        """Take one straight stretch; the contact that it ended, if it ended one."""
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
    axis = Rotation.from_quat(b.quaternion).as_matrix()[:, 2]
    return min(math.hypot(way[0], way[1]), float(np.linalg.norm(way - (way @ axis) * axis)))
