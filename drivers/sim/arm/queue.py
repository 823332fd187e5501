"""The arm's queue with what a controller adds: moves in joints, and holding and resuming the path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from brushloop.drivers.geometry import distance
from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.arm.kinematics import Joints, Matrix, forward, inverse, inverted, matrix_of, pose_of
from brushloop.drivers.sim.arm.motion import SAME_POSE_DEG, SAME_POSE_MM, MotionQueue
from brushloop.drivers.sim.arm.paths import JointLine, Part
from brushloop.drivers.sim.arm.plan import Move

SAME_JOINT_RAD = 1e-6


class ArmQueue(MotionQueue):
    """A `MotionQueue` with moves in joints, which can hold and resume its path. `tool` is the true flange to tip."""

    def __init__(
        self, home: Pose, on_path: Callable[[Pose, Pose], None], tool: Matrix | None = None, capacity: int = 64
    ) -> None:
        super().__init__(home, on_path, capacity)
        self.tool: Matrix = np.eye(4) if tool is None else tool
        self._held: list[Move] | None = None
        self._solved: tuple[Pose, Joints] | None = None
        """The last pose whose joints were found, and the joints."""

    @property
    def size(self) -> int:
        """Number of moves queued, running or held; one that decelerates into a hold counts once."""
        return len(self._held) if self._held is not None else super().size

    @property
    def held(self) -> bool:
        """True between `hold` and `resume`, even if nothing was moving."""
        return self._held is not None

    def add_joints(self, joints: Joints, speed_rad_s: float, acc_rad_s2: float, now_s: float, least_s: float) -> bool:
        """Append a straight move in joint space, from rest to rest; False if the queue already ends there."""
        self.advance(now_s)
        target = pose_of(forward(joints) @ self.tool)
        travel_mm, turn_deg = distance(self._last(), target)
        idle = not self._queue and not self._held
        turned = max(abs(a - b) for a, b in zip(joints, self.near, strict=True))
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG and (not idle or turned <= SAME_JOINT_RAD):
            return False
        path = JointLine(self._last_joints(), joints, self.tool)
        self._append(Move(self._next_id, path, speed_rad_s, acc_rad_s2, least_s), now_s)
        return True

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the path and forget the rest, held or not; this ends a hold."""
        super().stop(acc_mm_s2, acc_rad_s2, now_s)
        self._held = None

    def hold(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the path and keep it; `exec_id` stays that of the move in which the arm comes to rest."""
        self.advance(now_s)
        if self._held is not None:
            return
        moves, planned = self._moves, list(self._queue)
        resting = self._brake(acc_mm_s2, acc_rad_s2, now_s)
        # a move that was already braking has lost its target; moves queued behind it have not begun
        self._held = moves if resting is None else []
        if resting is None:
            return
        segment, done = resting
        rest = next(i for i, m in enumerate(moves) if m.ident == segment.ident)
        move = moves[rest]
        if segment.corner:
            after = next(s.enter for s in planned if s.ident == segment.ident and not s.corner)
            rest_of_it = Part(segment.path, segment.enter + done)
            first = replace(move, lead=(rest_of_it, segment.ramp.speed), enter=after)
        else:
            first = replace(move, enter=segment.enter + done, lead=None, held=True)
        self._held = [first, *moves[rest + 1 :]]

    def resume(self, now_s: float) -> None:
        """Resume the path that was held, from where the arm came to rest."""
        self.advance(now_s)
        held, self._held = self._held, None
        if held:
            self._moves = [*self._moves, *held]
            self._replan(0, now_s)

    def set_fraction(self, fraction: float, now_s: float) -> None:
        """Run every move that has not begun at this share of its speed, 0 to 1."""
        self.advance(now_s)
        self.fraction = fraction
        begun = {s.ident for s in self._queue if s.begin_s <= now_s}
        first = next((i for i, m in enumerate(self._moves) if m.ident not in begun), len(self._moves))
        self._replan(first, now_s)

    def exec_id(self, now_s: float) -> int:
        """Id of the running move, or of the one that is held; -1 when there is none."""
        ident = super().exec_id(now_s)
        return self._held[0].ident if ident == -1 and self._held else ident

    def joints(self, now_s: float) -> Joints:
        """Joint positions for the present pose of the tip."""
        self.advance(now_s)
        exact = self._queue[0].joints(now_s) if self._queue else None
        return exact or self.near_joints(self.pose(now_s))

    def near_joints(self, tip: Pose) -> Joints:
        """The joints for a tip pose, near the last known ones; the last known ones if no solution is found."""
        if self._solved != (tip, self.near):  # an arm at rest is asked again and again
            self.near = inverse(matrix_of(tip) @ inverted(self.tool), self.near) or self.near
            self._solved = (tip, self.near)
        return self.near

    def _last(self) -> Pose:
        return self._held[-1].path.pose(self._held[-1].path.length) if self._held else super()._last()

    def _last_joints(self) -> Joints:
        path = (self._held or self._moves)[-1].path if self._held or self._moves else None
        if path is not None:
            exact = path.joints(path.length)
        else:
            exact = self._queue[-1].joints(self._queue[-1].end_s) if self._queue else None
        return exact or self.near_joints(self._last())

    def _append(self, move: Move, now_s: float) -> None:
        if self._held is None:
            super()._append(move, now_s)
        else:
            self._next_id += 1
            self._held.append(move)
