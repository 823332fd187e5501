"""Motion that a client steers as it goes: velocities until further notice, and positions one small step at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.samples import Pose
from drivers.sim.arcs.motion import ArmQueue
from drivers.sim.arm.drift import Drift, JointDrift
from drivers.sim.arm.kinematics import Joints, Matrix, inverted
from drivers.sim.arm.motion import Segment
from drivers.sim.arm.paths import JointLine, Line, Path, fixed
from drivers.sim.arm.plan import Ramp

STILL = (0.0,) * 6


class StreamedQueue(ArmQueue):
    """An `ArmQueue` that also takes velocities and servo steps. Neither mixes with queued moves."""

    def drifting(self, now_s: float) -> bool:
        """True while a velocity lasts, slowing down at its end included."""
        self.advance(now_s)
        return bool(self._queue) and isinstance(self._queue[0].path, Drift | JointDrift)

    def settling_s(self, acc: float, now_s: float) -> float:
        """How long a velocity that lasts now takes to end at `acc`, in the units of that velocity."""
        self.advance(now_s)
        path = self._queue[0].path if self._queue else None
        if not isinstance(path, Drift | JointDrift):
            return 0.0
        return replace(path, v0=path.velocity(self._queue[0].at(now_s)[0]), v1=STILL, acc=acc).turn_s

    def drift(self, velocity: Sequence[float], acc: float, t: float, until_s: float, now_s: float) -> None:
        """Take the tip to a velocity, [mm/s x3, rad/s x3] in the base frame at `acc` mm/s2, for `until_s` at most.

        Where `t` (0: no end) is over before the velocity is reached, the arm slows down to rest instead.
        """
        start, v0 = self.pose(now_s), self._velocity(now_s, Drift)
        self._drive(Drift(start, v0, tuple(velocity), acc), t, until_s, now_s)

    def drift_joints(self, velocity: Sequence[float], acc: float, t: float, until_s: float, now_s: float) -> None:
        """Take the joints to velocities in rad/s at `acc` rad/s2, as `drift` does."""
        start, v0 = self.joints(now_s), self._velocity(now_s, JointDrift)
        self._drive(JointDrift(start, v0, tuple(velocity), acc, self.tool), t, until_s, now_s)

    def servo(self, target: Pose, step_s: float, fastest_mm_s: float, now_s: float, fix: Matrix | None = None) -> bool:
        """Be at a pose `step_s` after the last one, at an even speed; False, and nothing, where that is too fast."""
        self.advance(now_s)
        start = self._last() if fix is None else fixed(self._last(), inverted(fix))
        line = Line(start, target, fix)
        return self._step(line, step_s, fastest_mm_s * 1e-3 if line.angular else fastest_mm_s, now_s)

    def servo_joints(self, target: Joints, step_s: float, fastest_rad_s: float, now_s: float) -> bool:
        """Be at joints `step_s` after the last ones; False, and nothing, where that is too fast."""
        self.advance(now_s)
        return self._step(JointLine(self._last_joints(), target, self.tool), step_s, fastest_rad_s, now_s)

    def _step(self, line: Line | JointLine, step_s: float, fastest: float, now_s: float) -> bool:
        speed = line.length / step_s
        if speed > fastest:
            return False
        if line.length:
            ramp = Ramp(line.length, speed, math.inf, line.angular, speed, speed)
            self._put(line, ramp, self._queue[-1].end_s if self._queue else now_s)
        return True

    def _put(self, path: Path, ramp: Ramp, begin_s: float, *, stops: bool = False) -> None:
        self._queue.append(Segment(self._next_id, path, 0.0, ramp, begin_s, stops=stops))
        self._next_id += 1

    def _velocity(self, now_s: float, kind: type[Drift | JointDrift]) -> tuple[float, ...]:
        """The velocity now; rest, where the arm moves in another way."""
        front = self._queue[0] if self._queue else None
        if front is None or not isinstance(front.path, kind):
            return STILL
        return front.path.velocity(front.at(now_s)[0])

    def _drive(self, drift: Drift | JointDrift, t: float, until_s: float, now_s: float) -> None:
        self._cut(now_s)
        short = 0.0 < t < drift.turn_s
        going = replace(drift, length=t if short else until_s)
        self._put(going, _timed(going.length), now_s)
        self._slow_down(going, drift.acc, now_s + going.length)

    def _slow_down(self, going: Drift | JointDrift, acc: float, begin_s: float) -> None:
        here = going.length
        start, velocity = (going.joints(here) or going.pose(here)), going.velocity(here)
        rest = replace(going, start=start, v0=velocity, v1=STILL, acc=acc)  # pyright: ignore[reportArgumentType]
        self._put(replace(rest, length=rest.turn_s), _timed(rest.turn_s), begin_s, stops=True)

    def _cut(self, now_s: float) -> Drift | JointDrift | None:
        """End a velocity here and now, and forget what was to follow."""
        front = self._queue[0] if self._queue else None
        self._queue.clear()
        if front is None or not isinstance(front.path, Drift | JointDrift):
            return None
        gone = replace(front.path, length=front.at(now_s)[0])
        self._finish(replace(front, path=gone, ramp=_timed(gone.length)))
        return gone

    def _brake(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> tuple[Segment, float] | None:
        if not self.drifting(now_s) or self._queue[0].stops:
            return super()._brake(acc_mm_s2, acc_rad_s2, now_s)
        ident = self._queue[0].ident
        gone = self._cut(now_s)
        assert gone is not None
        self._slow_down(gone, acc_rad_s2 if isinstance(gone, JointDrift) else acc_mm_s2, now_s)
        self._queue[0] = replace(self._queue[0], ident=ident)
        return self._queue[0], 0.0


def _timed(seconds: float) -> Ramp:
    """A second for every second."""
    return Ramp(seconds, 1.0, math.inf, v_in=1.0, v_out=1.0)
