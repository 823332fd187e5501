"""The arm's queue as a controller knows it: moves in joints, circles and splines, held paths."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.geometry import distance
from drivers.samples import Pose
from drivers.sim.arm.curves import Arc, Spline
from drivers.sim.arm.kinematics import Joints, Matrix, forward, inverse, inverted, matrix_of, pose_of
from drivers.sim.arm.motion import SAME_POSE_DEG, SAME_POSE_MM, MotionQueue
from drivers.sim.arm.paths import JointLine, Part, Path, fixed
from drivers.sim.arm.plan import Move

SAME_JOINT_RAD = 1e-6
DT_S = 1e-3


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a move goes: speed and acceleration in mm and s, or rad and s, and the time it takes at least."""

    speed: float
    acc: float
    duration_s: float = 0.0
    blend_mm: float = 0.0


class ArmQueue(MotionQueue):
    """A `MotionQueue` that knows joints, and can hold its path and go on with it. `tool` is the true flange to tip."""

    def __init__(
        self, home: Pose, on_path: Callable[[Pose, Pose], None], tool: Matrix | None = None, capacity: int = 64
    ) -> None:
        super().__init__(home, on_path, capacity)
        self.tool: Matrix = np.eye(4) if tool is None else tool
        self._held: list[Move] | None = None
        self._spline: list[Joints] = []

    @property
    def size(self) -> int:
        """Moves that are queued, running or held; one that decelerates into a hold counts once."""
        return len(self._held) if self._held is not None else super().size

    @property
    def held(self) -> bool:
        """True between `hold` and `resume`, also where nothing was under way."""
        return self._held is not None

    def add_joints(self, joints: Joints, pace: Pace, now_s: float) -> bool:
        """Append a move that is straight in joints; False where the arm will be there already."""
        self.advance(now_s)
        target = pose_of(forward(joints) @ self.tool)
        travel_mm, turn_deg = distance(self._last(), target)
        idle = not self._queue and not self._held
        turned = max(abs(a - b) for a, b in zip(joints, self.near, strict=True))
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG and (not idle or turned <= SAME_JOINT_RAD):
            return False
        self._append(_move(self._next_id, JointLine(self._last_joints(), joints, self.tool), pace), now_s)
        return True

    def add_arc(self, via: Pose, end: Pose, mode: int, fix: Matrix | None, pace: Pace, now_s: float) -> None:
        """Append a circle through `via` to `end`. Raises ValueError where there is none.

        On a circle of radius r the speed stays below sqrt(acc r), so that the bend needs no more than `acc`.
        """
        self.advance(now_s)
        start = self._last() if fix is None else fixed(self._last(), inverted(fix))
        arc = Arc(start, via, end, mode, fix)
        speed = min(pace.speed, math.sqrt(pace.acc * arc.radius_mm))
        self._append(_move(self._next_id, arc, replace(pace, speed=speed, blend_mm=0.0)), now_s)

    def spline_through(self, joints: Joints, now_s: float) -> None:
        """Note a point for `add_spline`."""
        self.advance(now_s)
        if joints != (self._spline[-1] if self._spline else None):
            self._spline.append(joints)

    def add_spline(self, pace: Pace, now_s: float) -> bool:
        """Append the spline through the points noted since the last one; False where there are none."""
        self.advance(now_s)
        points, self._spline = [self._last_joints(), *self._spline], []
        if len(points) > 1 and max(abs(a - b) for a, b in zip(points[0], points[1], strict=True)) <= SAME_JOINT_RAD:
            del points[0]
        if len(points) < 2:
            return False
        spline = Spline(points, self.tool)
        speed = pace.speed / spline.steepest
        if spline.sharpest > 0.0:
            speed = min(speed, math.sqrt(pace.acc / spline.sharpest))
        acc = pace.acc / spline.steepest
        self._append(_move(self._next_id, spline, replace(pace, speed=speed, acc=acc, blend_mm=0.0)), now_s)
        return True

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the path and forget the rest, held or not; this ends a hold."""
        super().stop(acc_mm_s2, acc_rad_s2, now_s)
        self._held, self._spline = None, []

    def hold(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the path and keep it; the id stays that of the move in which the arm comes to rest."""
        self.advance(now_s)
        if self._held is not None:
            return
        moves, planned = self._moves, list(self._queue)
        resting = self._brake(acc_mm_s2, acc_rad_s2, now_s)
        # what was already braking has forgotten where it was going; what was queued behind it has not begun
        self._held = moves if resting is None else []
        if resting is None:
            return
        segment, done = resting
        rest = next((i for i, m in enumerate(moves) if m.ident == segment.ident), None)
        if rest is None:
            return  # speed or servo motion: there is no path to keep
        move = moves[rest]
        if segment.corner:
            after = next(s.enter for s in planned if s.ident == segment.ident and not s.corner)
            rest_of_it = Part(segment.path, segment.enter + done)
            first = replace(move, lead=(rest_of_it, segment.ramp.speed), enter=after)
        else:
            first = replace(move, enter=segment.enter + done, lead=None, held=True)
        self._held = [first, *moves[rest + 1 :]]

    def resume(self, now_s: float) -> None:
        """Go on with the path that was held, from where the arm came to rest."""
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
        """The joints that put the tip where it is."""
        self.advance(now_s)
        exact = self._queue[0].joints(now_s) if self._queue else None
        return exact or self.near_joints(self.pose(now_s))

    def blending(self, now_s: float) -> bool:
        """True in a corner between two moves."""
        self.advance(now_s)
        return bool(self._queue) and self._queue[0].corner

    def progress(self, now_s: float) -> float:
        """Share of the running move that is done, 0 to 1; 0 at rest."""
        self.advance(now_s)
        if not self._queue:
            return 0.0
        front = self._queue[0]
        done = front.enter + front.at(now_s)[0]
        # half of a corner lies on the move before
        whole = next((s.path for s in self._queue if s.ident == front.ident and not s.corner), front.path)
        return (0.5 * done if front.corner else done) / whole.length if whole.length else 0.0

    def times(self, ident: int, now_s: float) -> tuple[float, float]:
        """(from the first piece that a move still has to its end, from now to its end) in s; zeros where it is over."""
        self.advance(now_s)
        mine = [s for s in self._queue if s.ident == ident]
        return (mine[-1].end_s - mine[0].begin_s, mine[-1].end_s - now_s) if mine else (0.0, 0.0)

    def velocity(self, now_s: float) -> tuple[float, ...]:
        """[mm/s x3, rad/s x3] of the tip in the base frame, over the next millisecond."""
        self.advance(now_s)
        if not self._queue:
            return (0.0,) * 6
        front = self._queue[0]
        a, b = front.pose(now_s), front.pose(now_s + DT_S)
        turn = Rotation.from_quat(b.quaternion) * Rotation.from_quat(a.quaternion).inv()
        way = np.subtract(b.position_mm, a.position_mm)
        return tuple(float(v) / DT_S for v in (*way, *turn.as_rotvec()))

    def joint_velocity(self, now_s: float) -> tuple[float, ...]:
        """Of every joint in rad/s, over the next millisecond."""
        self.advance(now_s)
        if not self._queue:
            return (0.0,) * 6
        front, later_s = self._queue[0], now_s + DT_S
        a = self.joints(now_s)
        b = front.joints(later_s) or self.near_joints(front.pose(later_s))
        return tuple((q - p) / DT_S for p, q in zip(a, b, strict=True))

    def ends(self, now_s: float) -> Pose:
        """Where the running move ends; where the arm is, at rest."""
        self.advance(now_s)
        return next((m.path.pose(m.path.length) for m in (*(self._held or ()), *self._moves)), self.pose(now_s))

    def near_joints(self, tip: Pose) -> Joints:
        """The joints for a tip pose, near those seen last; those themselves where no solution is found."""
        self.near = inverse(matrix_of(tip) @ inverted(self.tool), self.near) or self.near
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


def _move(ident: int, path: Path, pace: Pace) -> Move:
    return Move(ident, path, pace.speed, pace.acc, pace.duration_s, pace.blend_mm)
