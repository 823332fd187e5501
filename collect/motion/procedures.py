"""What the arm does in each step. Every procedure begins and ends at safe height."""

from __future__ import annotations

import math
from collections.abc import Iterable

from brushloop.collect.errors import StepVoid
from brushloop.collect.motion.moves import (
    Move,
    commanded,
    inking_moves,
    over_sheet_move,
    park_moves,
    press_moves,
    retreat_moves,
    stroke_moves,
    zero_touch_moves,
)
from brushloop.collect.photograph.photographer import ArmTrips, Photographer
from brushloop.collect.protocols.steps import Drawn
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import Rig, limits_of
from brushloop.collect.rig.paper import PaperPlane, Patch, to_paper
from brushloop.drivers.devices import Frame, QueuedLine
from brushloop.drivers.limits import Limits
from brushloop.sessions.records import Condition

DEPTH_TOLERANCE_MM = 0.1
"""How far the depth at the end of the dwell may be from the requested one."""
TOUCH_TOLERANCE_MM = 0.1
"""How far the arm may rest from the taught height at zero touch."""
THERE_MM = 0.1
"""How far from the beginning of a dip the arm counts as being there."""


class Procedures:
    """Carries out the moves of each step on the devices of a rig."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._config = rig.config
        self.plane = PaperPlane(rig.config.paper.touch_z_mm)
        """Level, at the taught height, until touches have measured it."""
        self._dips = 0
        over = over_sheet_move(rig.config)
        self.photographer = Photographer(
            rig.robot,
            rig.camera,
            rig.config.camera,
            rig.clock,
            ArmTrips(
                over_mm=over.target.position_mm,
                park_mm=rig.config.motion.park_mm,
                over=lambda: self.go(over),
                park=self.park,
                over_sheet=self._over_sheet,
            ),
        )

    async def retreat(self) -> None:
        """Lift along the tool axis to safe height, then park. A killed process may have left the brush down."""
        here = await self._rig.robot.take_up()
        limits_of(self._config).check_start("robot", here)
        for move in retreat_moves(self._config, here):
            await self.go(move)

    async def zero_touch(self) -> float:
        """Visit the taught touch height at the touch point; returns the height at which the arm rests, in mm.

        This confirms that the arm reaches the height that the operator taught. It does not measure the paper.
        """
        *down, up = zero_touch_moves(self._config)
        for move in down:
            await self.go(move)
        rests_mm = (await self._rig.robot.where()).z_mm
        off_mm = rests_mm - self._config.paper.touch_z_mm
        if abs(off_mm) > TOUCH_TOLERANCE_MM:
            raise StepVoid(f"zero touch rests {off_mm:+.3f} mm from the taught height; limit {TOUCH_TOLERANCE_MM} mm")
        await self.go(up)
        return rests_mm

    async def set_out(self) -> None:
        """Go to where the next dip or wash begins, at travel height."""
        await self.go(inking_moves(self._config, self._dips)[0])

    async def dip(self) -> None:
        """Dip into the well and wipe; wash first if a wash is due. After `set_out` the arm is there already."""
        first, *moves = inking_moves(self._config, self._dips)
        if math.dist((await self._rig.robot.where()).position_mm, first.target.position_mm) > THERE_MM:
            moves.insert(0, first)
        for move in moves:
            await self.go(move)
        self._dips += 1

    async def press(self, patch: Patch, condition: Condition, dwell_s: float) -> float:
        """Press once; returns the depth reached below the paper along its normal, in mm."""
        before, pressing = press_moves(self._config, self.plane, patch, condition, dwell_s)
        for move in before:
            await self.go(move)
        # From here on the arm lifts by itself, whatever happens to this program.
        lines = [QueuedLine(move.target, move.speed_mm_s, move.least_s) for move in pressing]
        seen = await self._rig.robot.sequence(lines, acc_mm_s2=self._config.motion.acc_mm_s2)
        reached_mm = max((-self.plane.above_mm(self._config.paper, pose) for pose in seen), default=0.0)
        if abs(reached_mm - condition.depth_mm) > DEPTH_TOLERANCE_MM:
            raise StepVoid(f"the depth was {reached_mm:.3f} mm, {condition.depth_mm:g} mm was commanded")
        return reached_mm

    async def stroke(self, patch: Patch, drawn: Drawn, number: int) -> float:
        """Draw stroke `number`, from 0, of a figure that `check_drawn` passed; begins and ends at safe height.

        Returns the depth at which the brush landed, in mm.
        """
        robot, motion = self._rig.robot, self._config.motion
        moves = stroke_moves(self._config, self.plane, patch, drawn.strokes[number], drawn.speed_mm_s)
        for move in moves.down:
            await self.go(move)
        depth_mm = -self.plane.above_mm(self._config.paper, await robot.where())
        way, pace_mm_s = moves.way.poses, moves.way.speed_mm_s
        await robot.follow(way, speed_mm_s=pace_mm_s, acc_mm_s2=motion.acc_mm_s2, blend_mm=drawn.blend_mm)
        for move in moves.up:
            await self.go(move)
        return depth_mm

    async def capture(self) -> Frame:
        """Park, and return the first frame exposed after the camera has shown the arm gone."""
        return await self.photographer.photograph()

    async def park(self) -> None:
        """Go out of the camera's view."""
        for move in park_moves(self._config):
            await self.go(move)

    async def _over_sheet(self) -> bool:
        here = await self._rig.robot.where()
        x_mm, y_mm = to_paper(self._config.paper, here.x_mm, here.y_mm)
        size_x_mm, size_y_mm = self._config.paper.size_mm
        return 0.0 <= x_mm <= size_x_mm and 0.0 <= y_mm <= size_y_mm

    async def go(self, move: Move) -> None:
        """Make one move and wait for its end."""
        motion = self._config.motion
        await self._rig.robot.move(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=motion.acc_mm_s2)


def check_drawn(config: RigConfig, plane: PaperPlane, limits: Limits, patches: Iterable[Patch], drawn: Drawn) -> None:
    """Check every pose of a figure on these patches. Raises `LimitExceeded`."""
    for patch in patches:
        for points in drawn.strokes:
            for pose, speed_mm_s in commanded(stroke_moves(config, plane, patch, points, drawn.speed_mm_s).parts):
                limits.check("robot", pose, speed_mm_s=speed_mm_s, acc_mm_s2=config.motion.acc_mm_s2)
