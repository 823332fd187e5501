"""One contact of brush and paper, from touching to lifting off, cut out of the path of the tip."""

from __future__ import annotations

import itertools
import math
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

    @property
    def deepest(self) -> Pose:
        """The first of the lowest poses."""
        return min(self.poses, key=lambda pose: pose.z_mm)

    @property
    def dragged(self) -> bool:
        """False for a press. Withdrawing along the brush's own axis is no drag, be it tilted."""
        return sum(_sideways_mm(a, b) for a, b in itertools.pairwise(self.poses)) > SIDEWAYS_MM


class ContactWatch:
    """Collects finished stretches of the path until the brush lifts off the plane at `paper_z_mm`."""

    def __init__(self, paper_z_mm: float) -> None:
        self._paper_z_mm = paper_z_mm
        self._poses: list[Pose] = []

    def travelled(self, start: Pose, end: Pose) -> Contact | None:
        """Take one straight stretch; the contact that it ended, if it ended one."""
        plane = self._paper_z_mm
        if start.z_mm < plane or end.z_mm < plane:
            if not self._poses:
                self._poses.append(start if start.z_mm < plane else self._crossing(start, end))
            self._poses.append(end if end.z_mm < plane else self._crossing(start, end))
        if end.z_mm < plane or not self._poses:
            return None
        contact, self._poses = Contact(tuple(self._poses)), []
        return contact

    def _crossing(self, start: Pose, end: Pose) -> Pose:
        return interpolate(start, end, (self._paper_z_mm - start.z_mm) / (end.z_mm - start.z_mm))


def _sideways_mm(a: Pose, b: Pose) -> float:
    """Way along the paper or across the brush's axis, whichever is shorter."""
    way = np.subtract(b.position_mm, a.position_mm)
    axis = Rotation.from_quat(b.quaternion).as_matrix()[:, 2]
    return min(math.hypot(way[0], way[1]), float(np.linalg.norm(way - (way @ axis) * axis)))
