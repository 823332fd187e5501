"""Timing of queued moves: trapezoidal ramps, rounded corners, and how fast each piece of the path begins and ends."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from brushloop.drivers.sim.arm.paths import Corner, Line, Path


@dataclass(frozen=True, slots=True)
class Ramp:
    """A speed profile: from `v_in` at `acc` to `speed`, then at `acc` to `v_out`; a short path does not reach `speed`.

    Lengths are in mm, or in rad if `angular`; time is in s. `v_in` and `v_out` must be within reach of each other.
    """

    length: float
    speed: float
    acc: float
    angular: bool = False
    v_in: float = 0.0
    v_out: float = 0.0

    @property
    def peak(self) -> float:
        """The speed between the two slopes."""
        if self.v_in >= self.speed:
            return max(self.speed, self.v_out)
        if not self.length:
            return self.v_in
        highest = math.sqrt(self.acc * self.length + 0.5 * (self.v_in * self.v_in + self.v_out * self.v_out))
        return max(min(self.speed, highest), self.v_in, self.v_out)

    @property
    def duration_s(self) -> float:
        """Time for the whole length."""
        return sum(self._times())

    def at(self, t: float) -> tuple[float, float]:
        """(distance, speed) at time `t`, clamped to the ends."""
        if t <= 0.0:
            return 0.0, self.v_in
        up_s, along_s, down_s = self._times()
        if t >= up_s + along_s + down_s:
            return self.length, self.v_out
        peak = self.peak
        if t < up_s:
            slope = math.copysign(self.acc, peak - self.v_in)
            return self.v_in * t + 0.5 * slope * t * t, self.v_in + slope * t
        if t >= up_s + along_s:
            left = up_s + along_s + down_s - t
            return self.length - self.v_out * left - 0.5 * self.acc * left * left, self.v_out + self.acc * left
        return 0.5 * (self.v_in + peak) * up_s + peak * (t - up_s), peak

    def _times(self) -> tuple[float, float, float]:
        if not self.length:
            return 0.0, 0.0, 0.0
        peak = self.peak
        up_s, down_s = abs(peak - self.v_in) / self.acc, (peak - self.v_out) / self.acc
        along = self.length - 0.5 * (self.v_in + peak) * up_s - 0.5 * (self.v_out + peak) * down_s
        return up_s, max(along, 0.0) / peak, down_s


def paced(length: float, speed: float, acc: float, duration_s: float, rests: int) -> float:
    """The speed at which a path of `length` takes `duration_s`, but at most `speed`.

    `rests` is the number of ends at rest. T(v) = length / v + rests v / (2 acc), solved for v.
    """
    fastest = min(speed, math.sqrt(2.0 * acc * length / rests)) if rests else speed
    if not length or duration_s <= length / fastest + 0.5 * rests * fastest / acc:
        return speed
    if not rests:
        return length / duration_s
    lead = acc * duration_s
    return (lead - math.sqrt(max(lead * lead - 2.0 * rests * acc * length, 0.0))) / rests


SHORTEST_CUT = 1e-6
SLACK = 1e-9
"""Tolerance for rounding of speeds."""


@dataclass(frozen=True, slots=True)
class Move:
    """One accepted move. Speeds in mm and s, or rad and s where the path is angular."""

    ident: int
    path: Path
    speed: float
    acc: float
    duration_s: float = 0.0
    blend_mm: float = 0.0
    """Distance from its end at which the tip may turn into the next move; 0 ends at rest."""
    enter: float = 0.0
    """Distance along its path at which it begins: after the corner that leads into it."""
    lead: tuple[Path, float] | None = None
    """Rest of that corner, and its speed, if the path was held within it."""
    held: bool = False
    """Whether it begins at rest at `enter`, because the path was held there."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A stretch of one move between two junctions at which speeds are matched."""

    ident: int
    path: Path
    begin: float
    """Distance along the path at which it begins."""
    length: float
    cap: float
    acc: float
    corner: bool = False
    even: bool = False
    """True for a whole corner, taken at constant speed: the bend needs all of the acceleration."""
    from_rest: bool = False


Corners = dict[tuple[int, int, float], Corner | None]
"""Corners by their two moves and the place where the first was held."""


def corner_of(a: Move, b: Move) -> Corner | None:
    """The corner between two moves, or None if the arm comes to rest between them."""
    if a.blend_mm <= 0.0:
        return None
    match a.path, b.path:
        case Line() as one, Line() as two if not one.angular and not two.angular and one.fix is two.fix:
            cut = min(a.blend_mm, 0.5 * one.length, 0.5 * two.length, one.length - a.enter)
            return Corner(one, two, cut) if cut > SHORTEST_CUT else None
        case _:
            return None


def pieces_of(
    moves: Sequence[Move], fraction: float, corners_known: Corners, first_cap: float | None = None
) -> list[Piece]:
    """The pieces of the moves and their corners, in order. `first_cap` is the speed of a first move that has begun.

    `corners_known` is read and extended.
    """
    corners: list[Corner | None] = []
    for a, b in itertools.pairwise(moves):
        key = (a.ident, b.ident, a.enter if a.held else 0.0)
        if key not in corners_known:
            corners_known[key] = corner_of(a, b)
        corners.append(corners_known[key])
    before, behind = [None, *corners], [*corners, None]
    enters = [corner.cut if corner else move.enter for move, corner in zip(moves, before, strict=True)]
    caps = [
        paced(m.path.length, m.speed * fraction, m.acc, m.duration_s, _rests(m, enter))
        for m, enter in zip(moves, enters, strict=True)
    ]
    caps[0] = caps[0] if first_cap is None else first_cap
    pieces: list[Piece] = []
    for i, (move, cap, enter) in enumerate(zip(moves, caps, enters, strict=True)):
        if move.lead is not None:
            rest, speed = move.lead
            pieces.append(Piece(move.ident, rest, 0.0, rest.length, min(speed, cap), move.acc, corner=True))
        rounded = behind[i]
        length = max(move.path.length - enter - (rounded.cut if rounded else 0.0), 0.0)
        from_rest = before[i] is None and move.lead is None
        pieces.append(Piece(move.ident, move.path, enter, length, cap, move.acc, from_rest=from_rest))
        if rounded is not None:
            acc = min(move.acc, moves[i + 1].acc)
            # the speed bends by `bend` v within 2 cut / v: an acceleration of v^2 bend / (2 cut)
            limit = math.sqrt(2.0 * rounded.cut * acc / max(rounded.bend, 1e-12))
            limit = min(cap, caps[i + 1], limit)
            ident = moves[i + 1].ident
            # from a rest just before the corner the arm speeds up within it
            pieces.append(Piece(ident, rounded, 0.0, rounded.length, limit, acc, corner=True, even=not move.held))
    return pieces


def speeds_of(pieces: Sequence[Piece], v_in: float) -> list[float] | None:
    """Speeds at the junctions, ends included, each as high as caps and accelerations allow; the last is 0.

    None if the arm, arriving with `v_in`, could not slow down in time.
    """
    speeds = [0.0] * (len(pieces) + 1)
    for i in range(len(pieces) - 1, -1, -1):
        piece = pieces[i]
        reach = speeds[i + 1] if piece.even else math.sqrt(speeds[i + 1] ** 2 + 2.0 * piece.acc * piece.length)
        if i == 0:
            if v_in > reach * (1.0 + SLACK) + SLACK:
                return None
            speeds[0] = v_in
        else:
            limit = 0.0 if piece.from_rest else min(pieces[i - 1].cap, piece.cap)
            speeds[i] = min(limit, reach)
    for i, piece in enumerate(pieces):
        reach = speeds[i] if piece.even else math.sqrt(speeds[i] ** 2 + 2.0 * piece.acc * piece.length)
        speeds[i + 1] = min(speeds[i + 1], reach)
    return speeds


def ramps_of(pieces: Sequence[Piece], v_in: float) -> list[Ramp] | None:
    """The timing of every piece, or None if the arm could not slow down in time."""
    speeds = speeds_of(pieces, v_in)
    if speeds is None:
        return None
    return [
        Ramp(p.length, min(p.cap, speeds[i]) if p.even else p.cap, p.acc, p.path.angular, speeds[i], speeds[i + 1])
        for i, p in enumerate(pieces)
    ]


def _rests(move: Move, enter: float) -> int:
    """Number of its ends at which the move is meant to be at rest."""
    return 2 - (enter > 0.0 and not move.held) - (move.blend_mm > 0.0)
