"""The loopback arm's motion: a queue of moves with trapezoidal timing and rounded corners, evaluated on demand.

Moves are lines in space or in joints, and the path can be held and resumed, as a controller does.

The result does not depend on when it is evaluated. A later move may change how an earlier one ends, but only if that
agrees with the motion so far; otherwise the arm comes to rest between the two.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from brushloop.drivers.geometry import distance
from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.arm.kinematics import HOME, Joints, Matrix, forward, inverse, inverted, matrix_of, pose_of
from brushloop.drivers.sim.arm.paths import JointLine, Line, Part, Path, fixed
from brushloop.drivers.sim.arm.plan import Corners, Move, Ramp, pieces_of, ramps_of

STEADY_LAG_S = 0.08
"""The controller reports steady a little after its queue is empty."""
SAME_POSE_MM = 1e-4
SAME_POSE_DEG = 1e-4
SAME_JOINT_RAD = 1e-6
RESTS_KEPT = 64
AGREES = 1e-6
"""Two timings that differ by less count as equal; in mm, rad, mm/s or rad/s."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A timed piece of a move, which begins at distance `enter` of `path`. From `stop_s`, if set, it decelerates."""

    ident: int
    path: Path
    enter: float
    ramp: Ramp
    begin_s: float
    corner: bool = False
    stop_s: float | None = None
    stop_acc: float = 0.0
    stops: bool = False
    """True for a piece that brakes for a stop or hold."""

    @property
    def end_s(self) -> float:
        """Time at which the piece ends."""
        if self.stop_s is None:
            return self.begin_s + self.ramp.duration_s
        done, speed = self.ramp.at(self.stop_s - self.begin_s)
        left = speed * speed - 2.0 * self.stop_acc * max(self.ramp.length - done, 0.0)
        return self.stop_s + (speed - math.sqrt(max(left, 0.0))) / self.stop_acc

    def at(self, now_s: float) -> tuple[float, float]:
        """(distance, speed) within the piece at `now_s`."""
        if self.stop_s is None or now_s <= self.stop_s:
            return self.ramp.at(now_s - self.begin_s)
        done, speed = self.ramp.at(self.stop_s - self.begin_s)
        dt = min(now_s, self.end_s) - self.stop_s
        return min(done + speed * dt - 0.5 * self.stop_acc * dt * dt, self.ramp.length), speed - self.stop_acc * dt

    def pose(self, now_s: float) -> Pose:
        """Where the tip is at `now_s`."""
        return self.path.pose(self.enter + self.at(now_s)[0])

    def joints(self, now_s: float) -> Joints | None:
        """The joints at `now_s`; None if the path is not given in joints."""
        return self.path.joints(self.enter + self.at(now_s)[0])

    def way(self) -> list[Pose]:
        """The travelled path, as the vertices of a polyline."""
        total = self.at(self.end_s)[0]
        pieces = self.path.stretches
        return [self.path.pose(self.enter + total * k / pieces) for k in range(pieces + 1)]


@dataclass(frozen=True, slots=True)
class Rest:
    """Time and place at which the tip came to rest, even for a moment."""

    at_s: float
    pose: Pose


class MotionQueue:
    """A queue of moves. `on_path(start, end)` is called for every stretch once it has been travelled.

    `tool` is the true flange to tip.
    """

    def __init__(
        self, home: Pose, on_path: Callable[[Pose, Pose], None], tool: Matrix | None = None, capacity: int = 64
    ) -> None:
        self.tool: Matrix = np.eye(4) if tool is None else tool
        self._held: list[Move] | None = None
        self._solved: tuple[Pose, Joints] | None = None
        """The last pose whose joints were found, and the joints."""
        self.fraction = 1.0
        """Speed factor for every move that has not begun."""
        self.near: Joints = HOME
        """The last known joints, from which inverse kinematics starts."""
        self._rest = home
        self._rest_since_s = -1.0
        self._on_path = on_path
        self._capacity = capacity
        self._queue: deque[Segment] = deque()
        self._moves: list[Move] = []
        """Every unfinished move, in order."""
        self._corners: Corners = {}
        self._next_id: int = 0
        self.rests: deque[Rest] = deque(maxlen=RESTS_KEPT)
        """The newest places and times at which the arm came to rest."""

    @property
    def full(self) -> bool:
        """True when another move would be refused."""
        return self.size >= self._capacity

    @property
    def size(self) -> int:
        """Number of moves queued, running or held; one that decelerates into a stop or a hold counts once."""
        return len({segment.ident for segment in self._queue} if self._held is None else self._held)

    @property
    def held(self) -> bool:
        """True between `hold` and `resume`, even if nothing was moving."""
        return self._held is not None

    @property
    def running(self) -> Segment | None:
        """The piece of the path that is being travelled; None at rest."""
        return self._queue[0] if self._queue else None

    def add(
        self,
        target: Pose,
        speed_mm_s: float,
        acc_mm_s2: float,
        now_s: float,
        duration_s: float = 0.0,
        *,
        blend_mm: float = 0.0,
        fix: Matrix | None = None,
    ) -> bool:
        """Append a line; return False if the last move already ends at the target.

        `target` is a pose of the configured tool centre point, and `fix` leads from there to the true tip.
        """
        self.advance(now_s)
        start = self._last() if fix is None else fixed(self._last(), inverted(fix))
        travel_mm, turn_deg = distance(start, target)
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG:
            return False
        line = Line(start, target, fix)
        unit = 1e-3 if line.angular else 1.0
        self._append(
            Move(
                self._next_id, line, speed_mm_s * unit, acc_mm_s2 * unit, duration_s, 0.0 if line.angular else blend_mm
            ),
            now_s,
        )
        return True

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

    def advance(self, now_s: float) -> None:
        """Retire every piece that is over by `now_s`."""
        while self._queue and self._queue[0].end_s <= now_s:
            segment = self._queue.popleft()
            if segment.corner:
                self._moves = [replace(m, lead=None) if m.ident == segment.ident else m for m in self._moves]
            elif not segment.stops:
                self._moves = [m for m in self._moves if m.ident != segment.ident]
            self._finish(segment)

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate along the path and forget the rest, held or not; a second stop changes nothing."""
        self.advance(now_s)
        self._brake(acc_mm_s2, acc_rad_s2, now_s)
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

    def pose(self, now_s: float) -> Pose:
        """Where the tip is."""
        self.advance(now_s)
        return self._queue[0].pose(now_s) if self._queue else self._rest

    def exec_id(self, now_s: float) -> int:
        """Id of the running move, or of the one that is held; -1 when there is none. A corner belongs to the move that
        it leads into."""
        self.advance(now_s)
        if self._queue:
            return self._queue[0].ident
        return self._held[0].ident if self._held else -1

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

    def steady(self, now_s: float) -> bool:
        """True once the queue has been empty for `STEADY_LAG_S`."""
        self.advance(now_s)
        return not self._queue and now_s - self._rest_since_s >= STEADY_LAG_S

    def _finish(self, segment: Segment) -> None:
        way = segment.way()
        self._rest, self._rest_since_s = way[-1], segment.end_s
        self.near = segment.joints(segment.end_s) or self.near
        if segment.ramp.v_out == 0.0:
            self.rests.append(Rest(segment.end_s, way[-1]))
        if segment.ramp.length:
            for start, end in itertools.pairwise(way):
                self._on_path(start, end)

    def _last(self) -> Pose:
        """Where the last accepted move ends."""
        if moves := self._held or self._moves:
            path = moves[-1].path
            return path.pose(path.length)
        return self._queue[-1].pose(self._queue[-1].end_s) if self._queue else self._rest

    def _last_joints(self) -> Joints:
        path = (self._held or self._moves)[-1].path if self._held or self._moves else None
        if path is not None:
            exact = path.joints(path.length)
        else:
            exact = self._queue[-1].joints(self._queue[-1].end_s) if self._queue else None
        return exact or self.near_joints(self._last())

    def _append(self, move: Move, now_s: float) -> None:
        self._next_id += 1
        if self._held is not None:
            self._held.append(move)
            return
        self._moves.append(move)
        first = self._moves[0].ident
        self._corners = {key: corner for key, corner in self._corners.items() if key[0] >= first}
        self._replan(0, now_s)

    def _replan(self, first: int, now_s: float) -> None:
        """Replan the timing that can still change, from the move at index `first` or a later one."""
        queue = list(self._queue)
        for k in range(first, len(self._moves)):
            chain = self._moves[k:]
            mine = [i for i, s in enumerate(queue) if s.ident == chain[0].ident and not s.stops]
            # a corner that was planned stays with the move before it; one that was held begins the chain
            at = next((i for i in mine if chain[0].lead or not queue[i].corner), len(queue))
            planned = queue[at] if at < len(queue) else None
            if planned is not None:
                begin_s, v_in = planned.begin_s, planned.ramp.v_in
            else:
                begin_s, v_in = (queue[-1].end_s if queue else now_s), 0.0
            if planned is not None and not chain[0].lead:
                chain = [replace(chain[0], enter=planned.enter), *chain[1:]]
            begun = planned if planned is not None and planned.begin_s < now_s else None
            pieces = pieces_of(
                chain, self.fraction, self._corners, None if begun is None or begun.corner else begun.ramp.speed
            )
            ramps = ramps_of(pieces, v_in)
            if ramps is None or (begun is not None and not _agree(begun.ramp, ramps[0], now_s - begun.begin_s)):
                continue
            del queue[at:]
            for piece, ramp in zip(pieces, ramps, strict=True):
                queue.append(Segment(piece.ident, piece.path, piece.begin, ramp, begin_s, piece.corner))
                begin_s += ramp.duration_s
            break
        self._queue = deque(queue)

    def _brake(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> tuple[Segment, float] | None:
        """Come to rest on the path; return (piece, distance within it) of that place, or None if nothing was moving."""
        queue, self._moves = list(self._queue), []
        if not queue or queue[0].stops:
            self._queue = deque(s for s in queue if s.stops)
            return None
        front, now_done = queue[0], queue[0].at(now_s)
        done, speed = now_done
        left, last = front.ramp.length - done, 0
        while queue[last].ramp.v_out > 0.0 and last + 1 < len(queue):
            last += 1
            left += queue[last].ramp.length
        # never farther than the path would have gone
        acc = max(acc_rad_s2 if front.ramp.angular else acc_mm_s2, speed * speed / (2.0 * left) if left > 0.0 else 0.0)
        braking = [replace(front, stop_s=now_s, stop_acc=acc, stops=True)]
        speed = math.sqrt(max(speed * speed - 2.0 * acc * (front.ramp.length - done), 0.0))
        at, rest = front, braking[0].at(braking[0].end_s)[0]
        for segment in queue[1 : last + 1]:
            if speed <= AGREES:
                break
            way = min(speed * speed / (2.0 * acc), segment.ramp.length)
            after = math.sqrt(max(speed * speed - 2.0 * acc * way, 0.0))
            ramp = Ramp(way, speed, acc, segment.ramp.angular, speed, after if after > AGREES else 0.0)
            braking.append(replace(segment, ramp=ramp, begin_s=braking[-1].end_s, stops=True))
            at, rest, speed = segment, way, after
        self._queue = deque(braking)
        return at, rest


def _agree(old: Ramp, new: Ramp, t: float) -> bool:
    """Whether the two timings have the same distance and speed at `t`."""
    return all(abs(a - b) <= AGREES for a, b in zip(old.at(t), new.at(t), strict=True))
