"""The loopback arm's motion: one path of lines and rounded corners, travelled with trapezoidal speed.

The path is a list of pieces. The speed at each junction is as high as the pieces' limits allow: a backward pass makes
sure that the arm can still slow down, a forward pass that it can be that fast. The path can be held and resumed, as a
controller does. Lengths are in mm, speeds in mm/s; in rad and rad/s where a path is angular.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance
from brushloop.drivers.sim.kinematics import (
    HOME,
    Corner,
    JointLine,
    Joints,
    Line,
    Matrix,
    Ramp,
    fixed,
    forward,
    inverse,
    inverted,
    matrix_of,
    pose_of,
)

STEADY_LAG_S = 0.08
"""The controller reports steady a little after its queue is empty."""
SAME_POSE_MM = 1e-4
SAME_POSE_DEG = 1e-4
SAME_JOINT_RAD = 1e-6
RESTS_KEPT = 64
SHORTEST_CUT = 1e-6
SLACK = 1e-9
"""Tolerance for rounding of speeds."""
REST = 1e-6
"""A speed, in mm/s or rad/s, below which the arm rests."""


@dataclass(frozen=True, slots=True)
class Move:
    """One accepted move. It ends at rest unless `blend_mm` is the distance from its end at which it may be left."""

    ident: int
    path: Line | JointLine
    speed: float
    acc: float
    duration_s: float = 0.0
    blend_mm: float = 0.0

    def paced(self, fraction: float, rests: int) -> float:
        """The speed at which it takes `duration_s`, but at most that share of its speed.

        `rests` is the number of its ends at rest. T(v) = length / v + rests v / (2 acc), solved for v.
        """
        length, speed = self.path.length, self.speed * fraction
        fastest = min(speed, math.sqrt(2.0 * self.acc * length / rests)) if rests else speed
        if not length or self.duration_s <= length / fastest + 0.5 * rests * fastest / self.acc:
            return speed
        if not rests:
            return length / self.duration_s
        lead = self.acc * self.duration_s
        return (lead - math.sqrt(max(lead * lead - 2.0 * rests * self.acc * length, 0.0))) / rests


@dataclass(frozen=True, slots=True)
class Piece:
    """A stretch of the path between two junctions at which speeds are matched.

    A corner belongs to the move that it leads into, and is taken at constant speed, as the bend needs all of the
    acceleration; after a hold the arm speeds up within it.
    """

    move: Move
    path: Line | JointLine | Corner
    enter: float
    """Distance along the path at which it was begun."""
    begin: float
    """Distance along the path at which its timing begins."""
    end: float
    cap: float
    acc: float
    rests: int = 2
    even: bool = False

    @property
    def corner(self) -> bool:
        """Whether it joins two lines."""
        return isinstance(self.path, Corner)

    @property
    def length(self) -> float:
        """What is left of it."""
        return max(self.end - self.begin, 0.0)

    def joints(self, done: float) -> Joints | None:
        """The joints at a distance along its path; None where the path is not given in joints."""
        return self.path.joints(done) if isinstance(self.path, JointLine) else None


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece and its timing."""

    piece: Piece
    ramp: Ramp
    begin_s: float
    brakes: bool = False
    """True for a piece that brakes for a stop or hold."""

    @property
    def end_s(self) -> float:
        """Time at which the piece ends."""
        return self.begin_s + self.ramp.duration_s

    def at(self, now_s: float) -> tuple[float, float]:
        """(distance along the path, speed) at `now_s`."""
        done, speed = self.ramp.at(now_s - self.begin_s)
        return (self.piece.end if done >= self.ramp.length else self.piece.begin + done), speed


@dataclass(frozen=True, slots=True)
class Rest:
    """Time and place at which the tip came to rest, even for a moment."""

    at_s: float
    pose: Pose


def timed(pieces: Sequence[Piece], v_in: float, begin_s: float) -> list[Segment] | None:
    """The timing of pieces that are begun with `v_in` and end at rest; None if the arm could not slow down in time."""
    if not pieces:
        return []
    caps = [p.cap for p in pieces]
    for i in (i for i, p in enumerate(pieces) if p.corner):
        caps[i] = min(caps[max(i - 1, 0) : i + 2])
    speeds = [0.0] * (len(pieces) + 1)

    def reach(i: int, speed: float) -> float:
        return speed if pieces[i].even else math.sqrt(speed * speed + 2.0 * pieces[i].acc * pieces[i].length)

    for i in range(len(pieces) - 1, 0, -1):
        rounded = pieces[i - 1].corner or pieces[i].corner
        speeds[i] = min(caps[i - 1], caps[i], reach(i, speeds[i + 1])) if rounded else 0.0
    if v_in > reach(0, speeds[1]) * (1.0 + SLACK) + SLACK:
        return None
    speeds[0] = v_in
    segments: list[Segment] = []
    for i, piece in enumerate(pieces):
        speeds[i + 1] = min(speeds[i + 1], reach(i, speeds[i]))
        cap = min(caps[i], speeds[i]) if piece.even else caps[i]
        segments.append(Segment(piece, Ramp(piece.length, cap, piece.acc, speeds[i], speeds[i + 1]), begin_s))
        begin_s = segments[-1].end_s
    return segments


def joined(before: Sequence[Piece], move: Move, fraction: float) -> list[Piece]:
    """The pieces with a move appended, and with a corner into it where the last one may be left before its end."""
    last = before[-1] if before else None
    cut = 0.0
    match last.path if last else None, move.path:
        case Line() as a, Line() as b if last and not a.angular and not b.angular and a.fix is b.fix:
            cut = min(last.move.blend_mm, 0.5 * a.length, 0.5 * b.length, a.length - last.enter)
            if cut > SHORTEST_CUT:
                corner = Corner(a, b, cut)
                acc = min(last.acc, move.acc)
                # the speed bends by `bend` v within 2 cut / v: an acceleration of v^2 bend / (2 cut)
                limit = math.sqrt(2.0 * cut * acc / max(corner.bend, 1e-12))
                rests = 1 - (move.blend_mm > 0.0)
                return [
                    *before[:-1],
                    replace(last, end=a.length - cut),
                    Piece(move, corner, 0.0, 0.0, corner.length, limit, acc, even=True),
                    Piece(move, b, cut, cut, b.length, move.paced(fraction, rests), move.acc, rests),
                ]
        case _:
            pass
    rests = 2 - (move.blend_mm > 0.0)
    path = move.path
    return [*before, Piece(move, path, 0.0, 0.0, path.length, move.paced(fraction, rests), move.acc, rests)]


class MotionQueue:
    """A queue of moves. `on_path(start, end)` is called for every stretch once it has been travelled.

    `tool` is the true flange to tip. The path does not depend on when it is looked at.
    """

    def __init__(
        self, home: Pose, on_path: Callable[[Pose, Pose], None], tool: Matrix | None = None, capacity: int = 64
    ) -> None:
        self.tool: Matrix = np.eye(4) if tool is None else tool
        self.fraction = 1.0
        """Speed factor for every move that has not begun."""
        self.near: Joints = HOME
        """The last known joints, from which inverse kinematics starts."""
        self.rests: deque[Rest] = deque(maxlen=RESTS_KEPT)
        """The newest places and times at which the arm came to rest."""
        self._segments: list[Segment] = []
        self._held: list[Piece] | None = None
        """What is left of the path between `hold` and `resume`."""
        self._solved: tuple[Pose, Joints] | None = None
        """The last pose whose joints were found, and the joints."""
        self._rest = home
        self._rest_since_s = -1.0
        self._on_path = on_path
        self._capacity = capacity
        self._next_id = 0

    @property
    def full(self) -> bool:
        """True when another move would be refused."""
        return self.size >= self._capacity

    @property
    def size(self) -> int:
        """Number of moves queued, running or held; one that decelerates into a stop or a hold counts once."""
        pieces = [s.piece for s in self._segments] if self._held is None else self._held
        return len({piece.move.ident for piece in pieces})

    @property
    def held(self) -> bool:
        """True between `hold` and `resume`, even if nothing was moving."""
        return self._held is not None

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
        unit, blend = (1e-3, 0.0) if line.angular else (1.0, blend_mm)
        self._append(Move(self._next_id, line, speed_mm_s * unit, acc_mm_s2 * unit, duration_s, blend), now_s)
        return True

    def add_joints(self, joints: Joints, speed_rad_s: float, acc_rad_s2: float, now_s: float, least_s: float) -> bool:
        """Append a straight move in joint space, from rest to rest; False if the queue already ends there."""
        self.advance(now_s)
        target = pose_of(forward(joints) @ self.tool)
        travel_mm, turn_deg = distance(self._last(), target)
        idle = not self._segments and not self._held
        turned = max(abs(a - b) for a, b in zip(joints, self.near, strict=True))
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG and (not idle or turned <= SAME_JOINT_RAD):
            return False
        last = self._last_piece()
        start = (last.joints(last.end) if last else None) or self.near_joints(self._last())
        self._append(Move(self._next_id, JointLine(start, joints, self.tool), speed_rad_s, acc_rad_s2, least_s), now_s)
        return True

    def advance(self, now_s: float) -> None:
        """Retire every piece that is over by `now_s`."""
        while self._segments and self._segments[0].end_s <= now_s:
            self._finish(self._segments.pop(0))

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate along the path and forget the rest, held or not; a second stop changes nothing."""
        self._brake(acc_mm_s2, acc_rad_s2, now_s)
        self._held = None

    def hold(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the path and keep it; `exec_id` stays that of the move in which the arm comes to rest."""
        if self._held is None:
            self._held = self._brake(acc_mm_s2, acc_rad_s2, now_s)

    def resume(self, now_s: float) -> None:
        """Resume the path that was held, from where the arm came to rest."""
        self.advance(now_s)
        held, self._held = self._held, None
        self._segments += timed(held or [], 0.0, self._end_s(now_s)) or []

    def set_fraction(self, fraction: float, now_s: float) -> None:
        """Run every move that has not begun at this share of its speed, 0 to 1.

        A change that the arm could not follow in time takes effect with the next move.
        """
        self.fraction = fraction
        begun = self.exec_id(now_s)

        def slowed(piece: Piece) -> Piece:
            if piece.corner or piece.move.ident == begun:
                return piece
            return replace(piece, cap=piece.move.paced(fraction, piece.rests))

        self._held = None if self._held is None else [slowed(piece) for piece in self._held]
        self._retime([slowed(s.piece) for s in self._segments if not s.brakes], now_s)

    def pose(self, now_s: float) -> Pose:
        """Where the tip is."""
        self.advance(now_s)
        return self._segments[0].piece.path.pose(self._segments[0].at(now_s)[0]) if self._segments else self._rest

    def target(self, now_s: float) -> Pose | None:
        """End of the piece of the path that is being travelled; None at rest."""
        self.advance(now_s)
        return self._segments[0].piece.path.pose(self._segments[0].piece.end) if self._segments else None

    def exec_id(self, now_s: float) -> int:
        """Id of the running move, or of the one that is held; -1 when there is none. A corner belongs to the move that
        it leads into."""
        self.advance(now_s)
        if self._segments:
            return self._segments[0].piece.move.ident
        return self._held[0].move.ident if self._held else -1

    def joints(self, now_s: float) -> Joints:
        """Joint positions for the present pose of the tip."""
        self.advance(now_s)
        segment = self._segments[0] if self._segments else None
        exact = segment.piece.joints(segment.at(now_s)[0]) if segment else None
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
        return not self._segments and now_s - self._rest_since_s >= STEADY_LAG_S

    def _finish(self, segment: Segment) -> None:
        piece = segment.piece
        length = piece.end - piece.enter
        places = [piece.path.pose(piece.enter + length * k / piece.path.stretches) for k in range(piece.path.stretches)]
        places.append(piece.path.pose(piece.end))
        self._rest, self._rest_since_s = places[-1], segment.end_s
        self.near = piece.joints(piece.end) or self.near
        if segment.ramp.v_out == 0.0:
            self.rests.append(Rest(segment.end_s, places[-1]))
        if length > 0.0:
            for start, end in itertools.pairwise(places):
                self._on_path(start, end)

    def _last_piece(self) -> Piece | None:
        return (self._held or [s.piece for s in self._segments] or [None])[-1]

    def _last(self) -> Pose:
        """Where the last accepted move ends."""
        last = self._last_piece()
        return self._rest if last is None else last.path.pose(last.end)

    def _end_s(self, now_s: float) -> float:
        return self._segments[-1].end_s if self._segments else now_s

    def _append(self, move: Move, now_s: float) -> None:
        self._next_id += 1
        if self._held is not None:
            self._held = joined(self._held, move, self.fraction)
            return
        free = [s.piece for s in self._segments if not s.brakes]
        pieces = joined(free, move, self.fraction)
        if len(pieces) == len(free) + 1 or not self._retime(pieces, now_s):
            # it begins at rest: the moves before it stay as they are
            alone = joined([], move, self.fraction)
            self._segments += timed(alone, 0.0, self._end_s(now_s)) or []

    def _retime(self, pieces: list[Piece], now_s: float) -> bool:
        """Time the pieces anew from where the arm is; False, and no change, if it could not follow."""
        braking = [s for s in self._segments if s.brakes]
        begin_s, speed = (braking[-1].end_s if braking else now_s), 0.0
        if self._segments and not braking:
            done, speed = self._segments[0].at(now_s)
            if done > pieces[0].end:
                return False
            pieces = [replace(pieces[0], begin=done), *pieces[1:]]
        segments = timed(pieces, speed, begin_s)
        if segments is None:
            return False
        self._segments = [*braking, *segments]
        return True

    def _brake(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> list[Piece]:
        """Come to rest on the path; return what is left of it, from there on."""
        self.advance(now_s)
        free = [s for s in self._segments if not s.brakes]
        left_over = [s.piece for s in free]
        self._segments = [s for s in self._segments if s.brakes]
        if self._segments or not free:
            return left_over
        done, speed = free[0].at(now_s)
        left_over[0] = replace(left_over[0], begin=done)
        running = next(i for i, s in enumerate(free) if s.ramp.v_out == 0.0) + 1
        left = sum(piece.length for piece in left_over[:running])
        acc = acc_rad_s2 if left_over[0].path.angular else acc_mm_s2
        acc = max(acc, speed * speed / (2.0 * left) if left > 0.0 else 0.0)  # never farther than it would have gone
        while speed > REST and running:
            piece = left_over.pop(0)
            running -= 1
            stretch = min(speed * speed / (2.0 * acc), piece.length)
            after = math.sqrt(max(speed * speed - 2.0 * acc * stretch, 0.0))
            after = after if after > REST else 0.0
            rest = piece.begin + stretch
            ramp = Ramp(stretch, speed, acc, speed, after)
            self._segments.append(Segment(replace(piece, end=rest), ramp, self._end_s(now_s), brakes=True))
            speed = after
            if not after:
                left_over.insert(0, replace(piece, enter=rest, begin=rest))
        # from a rest in a corner, or just before one, the arm speeds up within it
        first = next((i for i, p in enumerate(left_over[:2]) if p.corner), None)
        if first is not None:
            left_over[first] = replace(left_over[first], even=False)
        return left_over
