"""One truth: where the tool is, whether it touches the paper or the ink, and what that leaves behind."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.geometry import brush_pose, lean
from drivers.samples import Pose
from drivers.sim.brush import Brush
from drivers.sim.clock import SimClock
from drivers.sim.config import SimConfig
from drivers.sim.motion import MotionQueue
from drivers.sim.paper import Paper

INK_PER_PRESS = 0.12
"""Share of a full brush that one press takes."""


@dataclass(frozen=True, slots=True)
class Press:
    """One contact of brush and paper, as it really happened: the answer sheet for tests."""

    index: int
    x_mm: float
    y_mm: float
    depth_mm: float
    tilt_deg: float
    heading_deg: float
    ink_load: float


class World:
    """Tool, brush, ink and sheet under one clock.

    The ink depends on where the tool went, not on when anyone looked: contact is followed along finished
    stretches of the path, and a contact leaves its mark when the brush lifts off.
    """

    def __init__(self, config: SimConfig) -> None:
        self.config = config
        self.clock = SimClock(config.rate)
        self.brush = Brush(config.brush)
        self.paper = Paper(*config.table.sheet_mm)
        self.presses: list[Press] = []
        self.ink_load = 0.0
        self.version = 0
        """Counts changes of what the camera can see on the sheet."""
        self._deepest: Pose | None = None
        self.motion = MotionQueue(brush_pose(*config.home_mm), self._travelled)

    def tool(self) -> Pose:
        """The tip's pose now, in the base frame."""
        return self.motion.pose(self.clock.now_s())

    def to_paper(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Base frame to paper frame, in the plane."""
        table = self.config.table
        dx, dy = x_mm - table.origin_mm[0], y_mm - table.origin_mm[1]
        yaw = math.radians(table.yaw_deg)
        return math.cos(yaw) * dx + math.sin(yaw) * dy, -math.sin(yaw) * dx + math.cos(yaw) * dy

    def _travelled(self, start: Pose, end: Pose) -> None:
        # Along a straight line the tip's height is linear, so the deepest point is one of the ends.
        for pose in (start, end):
            self._dip(pose)
            if pose.z_mm < self.config.table.paper_z_mm and (self._deepest is None or pose.z_mm < self._deepest.z_mm):
                self._deepest = pose
        if end.z_mm >= self.config.table.paper_z_mm and self._deepest is not None:
            deepest, self._deepest = self._deepest, None
            self._leave_mark(deepest)

    def _dip(self, pose: Pose) -> None:
        table = self.config.table
        x_mm, y_mm = self.to_paper(pose.x_mm, pose.y_mm)
        in_well = math.dist((x_mm, y_mm), table.well_mm) <= table.well_radius_mm
        if in_well and pose.z_mm < table.paper_z_mm + table.ink_level_mm:
            self.ink_load = 1.0

    def _leave_mark(self, deepest: Pose) -> None:
        table = self.config.table
        x_mm, y_mm = self.to_paper(deepest.x_mm, deepest.y_mm)
        if not (0.0 <= x_mm <= table.sheet_mm[0] and 0.0 <= y_mm <= table.sheet_mm[1]):
            return
        tilt_deg, base_heading_deg = lean(deepest)
        heading_deg = base_heading_deg - table.yaw_deg
        depth_mm = table.paper_z_mm - deepest.z_mm
        index = len(self.presses)
        footprint = self.brush.press(
            depth_mm, tilt_deg, ink_load=self.ink_load, press_seed=self.config.seed * 100_003 + index
        )
        self.paper.lay(footprint, x_mm, y_mm, heading_deg)
        self.presses.append(Press(index, x_mm, y_mm, depth_mm, tilt_deg, heading_deg, self.ink_load))
        self.ink_load = max(0.0, self.ink_load - INK_PER_PRESS)
        self.version += 1
