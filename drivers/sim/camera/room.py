"""What a second camera of a lab sees: the arm in the room from one side, drawn as a stick figure, and no sheet."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.arm.kinematics import Matrix, skeleton
from brushloop.drivers.sim.world import World

WIDTH_PX, HEIGHT_PX = 640, 480
PX_PER_M = 260.0
FOOT_PX = (320, 400)
"""The foot of the arm in the picture."""
WALL, TABLE, STEEL, BRUSH = 185, 95, 40, 15
NOISE = 2.0


class RoomScene:
    """The arm, seen along a level direction at `azimuth_rad` from the base's y axis."""

    def __init__(self, world: World, azimuth_rad: float) -> None:
        self._world = world
        self._across = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
        self._noise = np.random.default_rng([world.config.seed, 17])
        self._bones: Matrix = np.zeros((0, 3))

    def tool(self) -> Pose:
        """Pose of the tool now. Advances the world, so only the thread that owns the world may call it."""
        tip = self._world.tool()
        joints = self._world.motion.joints(self._world.clock.now_s())
        self._bones = np.vstack([skeleton(joints), np.array(tip.position_mm) / 1e3])
        return tip

    def render(self, host_ns: int = 0, tool: Pose | None = None) -> NDArray[np.uint8]:
        """A (480, 640) gray image of the arm at the last `tool()`."""
        image = np.full((HEIGHT_PX, WIDTH_PX), WALL, np.float32)
        image[FOOT_PX[1] :] = TABLE
        points = [self._place(bone) for bone in self._bones]
        for start, end in itertools.pairwise(points[:-1]):
            cv2.line(image, start, end, (STEEL,), 12)
        if points:
            cv2.line(image, points[-2], points[-1], (BRUSH,), 5)
        noisy = image + self._noise.normal(0.0, NOISE, image.shape)
        return np.clip(noisy, 0.0, 255.0).astype(np.uint8)

    def _place(self, at_m: Matrix) -> tuple[int, int]:
        return round(FOOT_PX[0] + PX_PER_M * float(at_m @ self._across)), round(FOOT_PX[1] - PX_PER_M * float(at_m[2]))
