"""The loopback controller's trajectory queue: lines and joint moves that can be held, resumed and slowed down.

It takes over the world's own queue when a controller is put in charge of the arm. Blending is accepted and not done:
every segment ends at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drivers.geometry import distance
from drivers.samples import Pose
from drivers.sim.kinematics import HOME, Joints, Matrix, forward, inverse, matrix_of, pose_of
from drivers.sim.motion import ROTATION_AS_LINEAR_MM, SAME_POSE_DEG, SAME_POSE_MM, MotionQueue, Ramp, Segment

SAME_JOINT_RAD = 1e-6
STRETCHES = 16
"""Straight pieces that a joint move is told to the world in."""


@dataclass(frozen=True, slots=True)
class Command:
    """One accepted move, before anything is known of when it begins. Speeds in mm and s, or rad and s for joints."""

    ident: int
    target: Pose
    speed: float
    acc: float
    duration_s: float
    joints: Joints | None = None
    tool: Matrix | None = None
    """Flange to tip, for joint moves."""


@dataclass(frozen=True, slots=True)
class JointSegment(Segment):
    """A move that is straight in joint space."""

    from_joints: Joints = HOME
    to_joints: Joints = HOME
    tool: Matrix | None = None

    def joints(self, now_s: float) -> Joints:
        """The joints at `now_s`."""
        share = self.share(now_s)
        q = [a + share * (b - a) for a, b in zip(self.from_joints, self.to_joints, strict=True)]
        return (q[0], q[1], q[2], q[3], q[4], q[5])

    def share(self, now_s: float) -> float:
        """How much of the way is done at `now_s`, 0 to 1."""
        if not self.ramp.length:
            return 1.0
        done, speed = self.ramp.at((now_s if self.stop_s is None else min(now_s, self.stop_s)) - self.begin_s)
        if self.stop_s is not None and now_s > self.stop_s:
            dt = min(now_s, self.end_s) - self.stop_s
            done += speed * dt - 0.5 * self.stop_acc * dt * dt
        return min(done / self.ramp.length, 1.0)

    def pose(self, now_s: float) -> Pose:
        """Where the tip is at `now_s`."""
        flange = forward(self.joints(now_s))
        return pose_of(flange if self.tool is None else flange @ self.tool)


class ArmQueue(MotionQueue):
    """A `MotionQueue` that can also hold its path, resume it, and run what has not begun at a fraction of its speed."""

    def __init__(self, home: Pose, on_path: Callable[[Pose, Pose], None], capacity: int = 64) -> None:
        super().__init__(home, on_path, capacity)
        self.fraction = 1.0
        self._next_id: int = 0
        self.near: Joints = HOME
        """The joints where the arm was last seen: where inverse kinematics begins."""
        self._commands: dict[int, Command] = {}
        self._held: list[Command] | None = None

    @classmethod
    def instead_of(cls, queue: MotionQueue) -> ArmQueue:
        """Take over from a queue in which nothing is under way."""
        return cls(queue._rest, queue._on_path, queue._capacity)  # pyright: ignore[reportPrivateUsage]

    @property
    def full(self) -> bool:
        """True when another move would be refused."""
        return self.size >= self._capacity

    @property
    def size(self) -> int:
        """Moves that are queued, running or held; one that decelerates into a hold counts once."""
        return len(self._held) if self._held is not None else len(self._queue)

    @property
    def held(self) -> bool:
        """True between `hold` and `resume`, also where nothing was under way."""
        return self._held is not None

    def add(self, target: Pose, speed_mm_s: float, acc_mm_s2: float, now_s: float, duration_s: float = 0.0) -> bool:
        """Append a line; False where the target is where the last move ends."""
        self.advance(now_s)
        travel_mm, turn_deg = distance(self._last(), target)
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG:
            return False
        self._append(Command(self._next_id, target, speed_mm_s, acc_mm_s2, duration_s), now_s)
        return True

    def add_joints(
        self, joints: Joints, tool: Matrix, speed_rad_s: float, acc_rad_s2: float, now_s: float, duration_s: float = 0.0
    ) -> bool:
        """Append a joint move; False where the arm will be there already."""
        self.advance(now_s)
        target = pose_of(forward(joints) @ tool)
        travel_mm, turn_deg = distance(self._last(), target)
        idle = not self._queue and not self._held
        turned = max(abs(a - b) for a, b in zip(joints, self.near, strict=True))
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG and (not idle or turned <= SAME_JOINT_RAD):
            return False
        command = Command(self._next_id, target, speed_rad_s, acc_rad_s2, duration_s, joints, tool)
        self._append(command, now_s)
        return True

    def advance(self, now_s: float) -> None:
        """Retire every segment that is over by `now_s`."""
        while self._queue and self._queue[0].end_s <= now_s:
            segment = self._queue.popleft()
            # A path that was held and resumed has its last part still to come, under the same id.
            if segment.ident not in (c.ident for c in (*self._queue, *(self._held or ()))):
                self._commands.pop(segment.ident, None)
            final = segment.pose(segment.end_s)
            self._rest, self._rest_since_s = final, segment.end_s
            pieces = 1
            if isinstance(segment, JointSegment):
                self.near, pieces = segment.joints(segment.end_s), STRETCHES
            span_s = segment.end_s - segment.begin_s
            way = [segment.start, *(segment.pose(segment.begin_s + span_s * k / pieces) for k in range(1, pieces))]
            for a, b in zip(way, [*way[1:], final], strict=True):
                self._on_path(a, b)

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the current segment and forget the rest, held or not; this ends a hold."""
        super().stop(acc_mm_s2, acc_rad_s2, now_s)
        self._held = None
        self._commands = {s.ident: self._commands[s.ident] for s in self._queue if s.ident in self._commands}

    def hold(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the current segment and keep the path; its id stays the one that is executed."""
        self.advance(now_s)
        if self._held is not None:
            return
        # A segment that was already stopped has forgotten where it was going.
        going = [s for s in self._queue if s.stop_s is None]
        self._held = [self._commands[s.ident] for s in going]
        super().stop(acc_mm_s2, acc_rad_s2, now_s)

    def resume(self, now_s: float) -> None:
        """Go on with the path that was held, from where the arm came to rest."""
        self.advance(now_s)
        held, self._held = self._held or [], None
        for command in held:
            self._plan(command, now_s)

    def set_fraction(self, fraction: float, now_s: float) -> None:
        """Run every move that has not begun at this share of its speed, 0 to 1."""
        self.advance(now_s)
        self.fraction = fraction
        waiting = [self._commands[s.ident] for s in list(self._queue)[1:]]
        while len(self._queue) > 1:
            self._queue.pop()
        for command in waiting:
            self._plan(command, now_s)

    def exec_id(self, now_s: float) -> int:
        """Id of the running segment, or of the one that is held; -1 when there is none."""
        ident = super().exec_id(now_s)
        return self._held[0].ident if ident == -1 and self._held else ident

    def joints(self, now_s: float) -> Joints | None:
        """The joints, where the running segment is a joint move."""
        self.advance(now_s)
        segment = self._queue[0] if self._queue else None
        return segment.joints(now_s) if isinstance(segment, JointSegment) else None

    def _last(self) -> Pose:
        """Where the last accepted move ends."""
        if self._held:
            return self._held[-1].target
        return self._queue[-1].rest if self._queue else self._rest

    def _append(self, command: Command, now_s: float) -> None:
        self._next_id += 1
        self._commands[command.ident] = command
        if self._held is not None:
            self._held.append(command)
        else:
            self._plan(command, now_s)

    def _plan(self, command: Command, now_s: float) -> None:
        before = self._queue[-1] if self._queue else None
        start, begin_s = (before.rest, before.end_s) if before else (self._rest, now_s)
        speed, acc = command.speed * self.fraction, command.acc
        if command.joints is None:
            travel_mm, turn_deg = distance(start, command.target)
            turn_rad = math.radians(turn_deg)
            if travel_mm < ROTATION_AS_LINEAR_MM and turn_rad > 1e-4:
                ramp = Ramp(turn_rad, speed / 1e3, acc / 1e3, angular=True)
            else:
                ramp = Ramp(travel_mm, speed, acc)
            ramp = _stretched(ramp, command.duration_s)
            self._queue.append(Segment(command.ident, start, command.target, ramp, begin_s))
            return
        origin = before.joints(before.end_s) if isinstance(before, JointSegment) else self.seen(start, command.tool)
        length = max(abs(a - b) for a, b in zip(command.joints, origin, strict=True))
        ramp = _stretched(Ramp(length, speed, acc, angular=True), command.duration_s)
        self._queue.append(
            JointSegment(
                command.ident,
                start,
                command.target,
                ramp,
                begin_s,
                from_joints=origin,
                to_joints=command.joints,
                tool=command.tool,
            )
        )

    def seen(self, tip: Pose, tool: Matrix | None) -> Joints:
        """The joints for a tip pose, near those seen last; those themselves where no solution is found."""
        flange = matrix_of(tip)
        if tool is not None:
            flange = flange @ np.linalg.inv(tool)
        self.near = inverse(flange, self.near) or self.near
        return self.near


def _stretched(ramp: Ramp, duration_s: float) -> Ramp:
    """The ramp slowed down to last `duration_s`; a duration can lengthen a move and never shorten it."""
    if duration_s <= ramp.duration_s or ramp.length == 0.0:
        return ramp
    lead = ramp.acc * duration_s
    return replace(ramp, speed=0.5 * (lead - math.sqrt(max(lead * lead - 4.0 * ramp.acc * ramp.length, 0.0))))
