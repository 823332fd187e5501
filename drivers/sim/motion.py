"""The loopback arm's motion: one path of lines and rounded corners by its length, and when the arm is where on it.

A backward pass over the path finds how fast the arm may pass each junction so that it can still slow down, a forward
pass how fast it can be there. The path can be held and resumed, as a controller does. Lengths are in mm, speeds in
mm/s; in rad and rad/s where a path is angular.
"""

import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance, interpolate
from brushloop.drivers.sim.kinematics import HOME, Joints, Matrix, inverse, matrix_of, pose_of

STEADY_LAG_S = 0.08
"""The controller reports steady a little after its queue is empty."""
SAME_POSE_MM = 1e-4
SAME_POSE_DEG = 1e-4
RESTS_KEPT = 64
SHORTEST_CUT = 1e-6
CORNER_SHARE = 0.5
"""Share of the acceleration that the bend of a corner may need; the rest is left for the speed along it."""
ROTATION_AS_LINEAR_MM = 1.0
"""Below this travel, ARCS reads speed and acceleration as rad/s and rad/s2."""
TURN_RAD = 1e-4
STRETCHES = 16
"""Number of straight pieces in which a curved path is reported to the world."""
ROUNDING = 1e-9
"""By which lengths and speeds may differ because sums of them are rounded."""


@dataclass(frozen=True, slots=True)
class Path:
    """A way of the tip, by its length in mm, or in rad where it is angular."""

    length: float
    pose: Callable[[float], Pose]
    """Where the tip is after some of the length; the ends are exact."""
    angular: bool
    stretches: int = STRETCHES


def line(start: Pose, end: Pose, travel_mm: float, turn_rad: float) -> Path:
    """Straight for the tip. `travel_mm` and `turn_rad` are those of the tool centre point that was configured."""
    angular = travel_mm < ROTATION_AS_LINEAR_MM and turn_rad > TURN_RAD
    length = turn_rad if angular else travel_mm

    def pose(done: float) -> Pose:
        if done >= length - ROUNDING:
            return end
        return start if done <= 0.0 else interpolate(start, end, done / length)

    return Path(length, pose, angular, stretches=1)


def corner(a: Path, b: Path, cut: float) -> Path:
    """The parabola that leaves the line `a` at `cut` before its end and meets `b` at `cut` after its start.

    Its length is the one that it replaces; the curve itself is shorter.
    """
    start, middle, end = a.pose(a.length - cut), a.pose(a.length), b.pose(cut)

    def pose(done: float) -> Pose:  # by de Casteljau's algorithm, turns included
        u = done / (2.0 * cut)
        return interpolate(interpolate(start, middle, u), interpolate(middle, end, u), u)

    return Path(2.0 * cut, pose, angular=False)


@dataclass(frozen=True, slots=True)
class Piece:
    """A stretch of the whole path; a corner belongs to the move that it leads into."""

    ident: int
    """Of its move."""
    path: Path
    origin: float
    """Where its own path begins, along the whole path; a corner may have cut that beginning off."""
    start: float
    """Where it begins, along the whole path."""
    stop: float
    """Where it ends, along the whole path."""
    cap: float
    """Highest speed."""
    acc: float
    blend_mm: float = 0.0
    """Distance from its end at which it may be left; 0 where it ends at rest."""
    through: bool = False
    """Whether the arm does not rest at its end, which leads into a corner or out of one."""

    def pose(self, along: float) -> Pose:
        """Where the tip is."""
        return self.path.pose(min(along, self.stop) - self.origin)


@dataclass(frozen=True, slots=True)
class Knot:
    """When the arm is where along the whole path, and how fast; between two knots its acceleration is constant."""

    at_s: float
    along: float
    speed: float

    def then(self, along: float, speed: float) -> "Knot":
        """The knot that follows."""
        way = max(along - self.along, 0.0)
        return Knot(self.at_s + (2.0 * way / (self.speed + speed) if way else 0.0), along, speed)


@dataclass(frozen=True, slots=True)
class Rest:
    """Time and place at which the tip came to rest, even for a moment."""

    at_s: float
    pose: Pose
    left_s: float
    """When the arm had left the rest before."""


def timetable(pieces: Sequence[Piece], start: Knot) -> list[Knot] | None:
    """The knots from `start`, in the first piece, to a rest at the end of the last; None if the arm is too fast."""

    def reach(piece: Piece, speed: float) -> float:
        way = piece.stop - max(piece.start, start.along)
        return math.sqrt(speed * speed + 2.0 * piece.acc * way)

    leaving = [0.0] * len(pieces)
    for i in range(len(pieces) - 1, 0, -1):
        before, piece = pieces[i - 1 : i + 1]
        if before.through:
            leaving[i - 1] = min(before.cap, piece.cap, reach(piece, leaving[i]))
    if start.speed > reach(pieces[0], leaving[0]) * (1.0 + ROUNDING) + ROUNDING:
        return None
    knots = [start]
    for piece, limit in zip(pieces, leaving, strict=True):
        v_in, v_out = knots[-1].speed, min(limit, reach(piece, knots[-1].speed))
        way = piece.stop - knots[-1].along
        highest = math.sqrt(piece.acc * way + 0.5 * (v_in * v_in + v_out * v_out))
        peak = max(min(piece.cap, highest), v_in, v_out)
        up, down = ((peak * peak - v * v) / (2.0 * piece.acc) for v in (v_in, v_out))
        knots.append(knots[-1].then(knots[-1].along + up, peak))
        knots.append(knots[-1].then(piece.stop - down, peak))
        knots.append(knots[-1].then(piece.stop, v_out))
    return knots


class MotionQueue:
    """A queue of moves. `on_path(start, end)` is called for every stretch once it has been travelled.

    `tool` is the true flange to tip. The path does not depend on when it is looked at.
    """

    def __init__(self, home: Pose, on_path: Callable[[Pose, Pose], None], tool: Matrix | None = None) -> None:
        self.tool: Matrix = np.eye(4) if tool is None else tool
        self.near: Joints = HOME
        """The last known joints, from which inverse kinematics starts."""
        self.rests: deque[Rest] = deque(maxlen=RESTS_KEPT)
        """The newest places and times at which the arm came to rest."""
        self.held = False
        """True between `hold` and `resume`, even if nothing was moving."""
        self._pieces: list[Piece] = []
        self._knots = [Knot(-1.0, 0.0, 0.0)]
        """From the last one passed on; the last is a rest, at the end of the path unless it is held."""
        self._rest = home
        self._left_s = -1.0
        """When the arm left the last rest, or came to it."""
        self._on_path = on_path
        self._next_id = 0

    def size(self, now_s: float) -> int:
        """Number of moves queued, running or held."""
        self.advance(now_s)
        return len({piece.ident for piece in self._pieces})

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
        """Append a line that takes at least `duration_s`; return False if the last move already ends at the target.

        `target` is a pose of the configured tool centre point, and `fix` leads from there to the true tip.
        """
        self.advance(now_s)
        start = self._pieces[-1].pose(self._pieces[-1].stop) if self._pieces else self._rest
        configured = start if fix is None else pose_of(matrix_of(start) @ np.linalg.inv(fix))
        travel_mm, turn_deg = distance(configured, target)
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG:
            return False
        end = target if fix is None else pose_of(matrix_of(target) @ fix)
        path = line(start, end, travel_mm, math.radians(turn_deg))
        unit, blend_mm = (1e-3, 0.0) if path.angular else (1.0, blend_mm)
        speed = speed_mm_s * unit if duration_s == 0.0 else min(speed_mm_s * unit, path.length / duration_s)
        here = self._knots[-1] if self.held else self._at(now_s)
        begin = self._pieces[-1].stop if self._pieces else here.along
        acc = acc_mm_s2 * unit
        piece = Piece(self._next_id, path, begin, begin, begin + path.length, speed, acc, blend_mm)
        self._next_id += 1
        rounded = self._rounded(piece, here.along)
        if rounded is not None:
            knots = self._knots if self.held else timetable(rounded, here)
            if knots is not None:
                self._pieces, self._knots = rounded, knots
                return True
        self._pieces.append(piece)  # it begins at rest: the moves before it stay as they are
        if not self.held:
            self._go_on([piece], now_s)
        return True

    def advance(self, now_s: float) -> None:
        """Retire every piece that is over by `now_s`."""
        while len(self._knots) > 1 and self._knots[1].at_s <= now_s:
            self._knots.pop(0)
            knot = self._knots[0]
            self._retire(knot.along)
            if knot.speed == 0.0:
                self.rests.append(Rest(knot.at_s, self._tip(knot), self._left_s))
                self._left_s = knot.at_s
        self._retire(self._at(now_s).along)

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate along the path and forget the rest, held or not."""
        self._brake(acc_mm_s2, acc_rad_s2, now_s)
        self.held, rest = False, self._knots[-1].along
        self._pieces = [
            replace(piece, stop=min(piece.stop, rest), blend_mm=0.0, through=piece.through and piece.stop < rest)
            for piece in self._pieces
            if piece.start < rest
        ]
        self.advance(now_s)

    def hold(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the path and keep it; `exec_id` stays that of the move in which the arm comes to rest."""
        if not self.held:
            self._brake(acc_mm_s2, acc_rad_s2, now_s)
            self.held = True

    def resume(self, now_s: float) -> None:
        """Resume the path that was held, from where the arm came to rest."""
        self.advance(now_s)
        self.held, rest = False, self._knots[-1]
        left = [piece for piece in self._pieces if piece.stop > rest.along]
        if left:
            self._go_on(left, now_s)

    def pose(self, now_s: float) -> Pose:
        """Where the tip is."""
        self.advance(now_s)
        return self._tip(self._at(now_s))

    def target(self, now_s: float) -> Pose | None:
        """End of the piece of the path that is being travelled; None at rest."""
        self.advance(now_s)
        return self._pieces[0].pose(self._pieces[0].stop) if len(self._knots) > 1 else None

    def exec_id(self, now_s: float) -> int:
        """Id of the running move, or of the one that is held; -1 when there is none. A corner belongs to the move that
        it leads into."""
        self.advance(now_s)
        return self._pieces[0].ident if self._pieces else -1

    def near_joints(self, tip: Pose) -> Joints:
        """The joints for a tip pose, near the last known ones; the last known ones if no solution is found."""
        self.near = inverse(matrix_of(tip) @ np.linalg.inv(self.tool), self.near) or self.near
        return self.near

    def steady(self, now_s: float) -> bool:
        """True once the arm has been at rest for `STEADY_LAG_S`."""
        self.advance(now_s)
        return len(self._knots) == 1 and now_s - self._knots[0].at_s >= STEADY_LAG_S

    def _at(self, now_s: float) -> Knot:
        """Where the arm is, once the knots that are over have been retired."""
        knot = self._knots[0]
        if len(self._knots) == 1 or now_s <= knot.at_s:
            return knot
        passed_s, whole_s = now_s - knot.at_s, self._knots[1].at_s - knot.at_s
        speed = knot.speed + (self._knots[1].speed - knot.speed) * passed_s / whole_s
        return Knot(now_s, knot.along + 0.5 * (knot.speed + speed) * passed_s, speed)

    def _tip(self, knot: Knot) -> Pose:
        begun = bool(self._pieces) and knot.along > self._pieces[0].start
        return self._pieces[0].pose(knot.along) if begun else self._rest

    def _retire(self, along: float) -> None:
        """Report the pieces that end no farther than `along`."""
        while self._pieces and self._pieces[0].stop <= along:
            piece = self._pieces.pop(0)
            lengths: list[float] = np.linspace(piece.start, piece.stop, piece.path.stretches + 1).tolist()
            places = [piece.pose(along) for along in lengths]
            self._rest = places[-1]
            for start, end in itertools.pairwise(places if piece.stop > piece.start else ()):
                self._on_path(start, end)

    def _go_on(self, pieces: Sequence[Piece], now_s: float) -> None:
        """Travel the pieces from the rest in which the timetable ends."""
        rest = self._knots[-1]
        start = Knot(max(rest.at_s, now_s), rest.along, 0.0)
        if len(self._knots) == 1:
            self._left_s = start.at_s
        self._knots[-1:] = timetable(pieces, start) or [rest]

    def _rounded(self, piece: Piece, along: float) -> list[Piece] | None:
        """The path with a move appended, and with a corner into it; None where the last move ends at rest.

        The corner has to begin beyond `along`.
        """
        if not self._pieces or self._pieces[-1].blend_mm == 0.0 or piece.path.angular:
            return None
        last, a, b = self._pieces[-1], self._pieces[-1].path, piece.path
        cut = min(last.blend_mm, 0.5 * a.length, 0.5 * b.length)
        if cut <= SHORTEST_CUT or last.stop - cut < along:
            return None
        directions = [np.subtract(w.pose(w.length).position_mm, w.pose(0.0).position_mm) / w.length for w in (a, b)]
        bend = float(np.linalg.norm(directions[1] - directions[0]))  # 0 for straight on, 2 for a reversal
        # the speed bends by `bend` v within 2 cut / v: an acceleration of v^2 bend / (2 cut)
        acc = min(last.acc, piece.acc)
        cap = min(math.sqrt(2.0 * cut * CORNER_SHARE * acc / max(bend, 1e-12)), last.cap, piece.cap)
        enter, bend_path = last.stop - cut, corner(a, b, cut)
        leave = enter + bend_path.length
        bent = Piece(piece.ident, bend_path, enter, enter, leave, cap, (1.0 - CORNER_SHARE) * acc, through=True)
        after = replace(piece, origin=leave - cut, start=leave, stop=leave - cut + b.length)
        return [*self._pieces[:-1], replace(last, stop=enter, through=True), bent, after]

    def _brake(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Come to rest on the path, never farther than the arm would have gone."""
        self.advance(now_s)
        if len(self._knots) == 1:
            return
        here, rest = self._at(now_s), next(knot for knot in self._knots[1:] if knot.speed == 0.0)
        acc = acc_rad_s2 if self._pieces[0].path.angular else acc_mm_s2
        self._knots = [here]
        if here.speed > 0.0:
            self._knots.append(here.then(min(here.along + here.speed**2 / (2.0 * acc), rest.along), 0.0))
