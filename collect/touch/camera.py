"""Zero touch by first ink: touch rows of fresh spots, each a little lower, and find where the ink begins."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.errors import StepError
from brushloop.collect.photograph.new_ink import before_and_after, ink_at
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import PaperPlane, fit_plane
from brushloop.collect.touch.arm import Effector, TouchArm
from brushloop.collect.touch.force import Floats
from brushloop.collect.touch.heights import KnownHeights, PointTouches, Reach, Touch, at_one_point, lowest_z_mm
from brushloop.collect.touch.places import SpotGrid, coarse_count, fine_count
from brushloop.drivers.devices import Frame


@dataclass(frozen=True, slots=True)
class FirstInk:
    """The two spots of a row between which the ink begins."""

    clean: int
    """Index of the last spot without ink."""
    inked: int
    """Index of the first one with ink; every spot after it has ink."""


def first_ink(ink_mm2: Floats, least_mm2: float) -> FirstInk:
    """Find where the ink begins in a row of spots, (m,) from the highest to the lowest.

    Raises `StepError` if the first spot has ink, if none has, or if a spot below an inked one has none: otherwise a
    brush that ran dry would be mistaken for one that did not touch.
    """
    seen = np.asarray(ink_mm2) >= least_mm2
    if not seen.any():
        raise StepError("no spot of the row left ink: nothing was touched")
    first = int(np.argmax(seen))
    if first == 0:
        raise StepError("the highest spot of the row has ink already: the paper lies higher than expected")
    if not seen[first:].all():
        missing = first + int(np.argmin(seen[first:]))
        raise StepError(f"spot {missing + 1} of the row left no ink though a higher one did: is the brush dry?")
    return FirstInk(first - 1, first)


Spot = tuple[float, float, float]
"""x and y in the paper frame, z of the tip in the base frame."""
WINDOW_SHARE = 0.75
"""Side of the window in which a spot's ink is measured, as a share of the pitch."""


class FirstInkTouch:
    """Touches by camera on one rig. The sheet must be blank where it touches."""

    def __init__(
        self,
        rig: Rig,
        effector: Effector,
        arm: TouchArm,
        config: TouchConfig,
    ) -> None:
        self._rig = rig
        self._effector = effector
        self._arm = arm
        self._config = config
        self._since_dip: int | None = None
        self._last: Frame | None = None

    async def measure(self, points_mm: list[tuple[float, float]]) -> list[PointTouches]:
        """Touch every point coarsely, then finely in rounds, each along the plane fitted to the previous round.

        Without that plane, the sheet's lean along a row would be mistaken for height. Raises `StepError`.
        """
        paper, extent_mm = self._rig.config.paper, self._config.camera.extent_mm
        known = KnownHeights(paper, self._config)
        grids = [
            SpotGrid(point, self._config.camera, paper.size_mm, lowest_z_mm(paper, self._config, *point, extent_mm))
            for point in points_mm
        ]
        rough: list[Touch] = []
        for grid, point in zip(grids, points_mm, strict=True):
            rough.append(await self._coarse(grid, known.reach(*point, extent_mm)))
            known.add(rough[-1].x_mm, rough[-1].y_mm, rough[-1].z_mm)
        rounds = [rough]
        for k in range(self._config.touches):
            lean = _plane(rounds[-1])
            # Staggered by parts of a step: equal heights would only repeat the same result.
            lower_mm = k / self._config.touches * self._config.camera.fine_step_mm
            rounds.append([await self._fine(p, around, lean, lower_mm) for p, around in zip(grids, rough, strict=True)])
        touches = [list(point) for point in zip(*rounds[1:], strict=True)]
        lean = _plane([touch for point in touches for touch in point])
        return [at_one_point(point, self._config, lean) for point in touches]

    async def _coarse(self, grid: SpotGrid, reach: Reach) -> Touch:
        """Touch lower and lower until a photograph shows ink."""
        camera = self._config.camera
        count = coarse_count(camera, reach)
        before = await self._photograph()
        spots: list[Spot] = []
        for k in range(count):
            spots.append((*grid.take(), max(reach.start_z_mm - k * camera.coarse_step_mm, reach.lowest_z_mm)))
            await self._touch(spots[-1])
            if len(spots) % camera.spots_per_photo == 0 or k + 1 == count:
                ink = await self._ink(before, spots)
                if (ink >= camera.least_ink_mm2).any():
                    return self._between(spots, ink, camera.coarse_step_mm)
        raise StepError(f"nothing was touched down to {spots[-1][2]:.2f} mm: no spot of the row left ink")

    async def _fine(self, grid: SpotGrid, around: Touch, lean: PaperPlane, lower_mm: float) -> Touch:
        camera = self._config.camera
        before, spots = await self._photograph(), list[Spot]()
        highest_mm = 0.5 * camera.fine_step_mm * (fine_count(camera) - 1) - lower_mm
        for k in range(fine_count(camera)):
            x, y = grid.take()
            along_mm = lean.touch_z_mm(x, y) - lean.touch_z_mm(around.x_mm, around.y_mm)
            z_mm = around.z_mm + along_mm + highest_mm - k * camera.fine_step_mm
            spots.append((x, y, max(z_mm, grid.lowest_z_mm)))
            await self._touch(spots[-1])
        return self._between(spots, await self._ink(before, spots), camera.fine_step_mm)

    def _between(self, spots: list[Spot], ink_mm2: NDArray[np.float64], step_mm: float) -> Touch:
        """Half way between the last clean spot and the first inked one; every height between them is equally likely."""
        edge = first_ink(ink_mm2, self._config.camera.least_ink_mm2)
        x, y, z = (0.5 * (a + b) for a, b in zip(spots[edge.clean], spots[edge.inked], strict=True))
        return Touch(x, y, z, step_mm / math.sqrt(12.0))

    async def _touch(self, spot: Spot) -> None:
        if self._since_dip is None or self._since_dip >= self._config.camera.spots_per_dip:
            await self._effector.dip()
            self._since_dip = 0
        x, y, z = spot
        await self._arm.over(x, y)
        await self._arm.near(x, y, z + self._config.above_mm)
        await self._arm.press(x, y, z)
        self._since_dip += 1
        self._last = None

    async def _photograph(self) -> Frame:
        if self._last is None:
            self._last = await self._effector.capture()
        return self._last

    async def _ink(self, before: Frame, spots: list[Spot]) -> NDArray[np.float64]:
        after = await self._photograph()
        return await asyncio.to_thread(self._measure_ink, before, after, spots)

    def _measure_ink(self, before: Frame, after: Frame, spots: list[Spot]) -> NDArray[np.float64]:
        first, second, image_to_paper = before_and_after(self._rig.config, before, after)
        side_mm = WINDOW_SHARE * self._config.camera.pitch_mm
        return ink_at(first, second, image_to_paper, [(x, y) for x, y, _ in spots], side_mm)


def _plane(touches: list[Touch]) -> PaperPlane:
    return fit_plane([(t.x_mm, t.y_mm, t.z_mm) for t in touches]).plane
