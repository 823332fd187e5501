"""How long a plan takes: trapezoids of speed, dwells, and what the camera and each halt add."""

from __future__ import annotations

import math

from collect.motion.moves import Move, Room, Way
from collect.planning.moves import StepMoves
from collect.rig.config import RigConfig
from collect.rig.devices import limits_of
from drivers.limits import Limits
from drivers.samples import Pose

SETTLE_S = 0.12
"""From the end of a ramp to the next command: the controller's lag in telling that it rests, half a poll, the calls.
Seen on the loopback rig; a cabinet's is not known."""
FRAME_S = 0.1
"""From one frame to the next at 10 frames a second: a picture waits for the second that begins after the arm rests."""
IN_PLACE_MM = 1.0
"""ARCS reads the speed of a shorter line as that of its turn: mm/s as thousandths of rad/s."""

OMITTED = (
    "connecting, power on, doses of ink, a touch that is measured instead of visited, quality checks, writing to disk, "
    "sheet changes, pauses, and presses made again"
)


def trapezoid_s(way: float, speed: float, acc: float) -> float:
    """Seconds from rest to rest; a triangle where the speed is not reached."""
    return way / speed + speed / acc if way * acc >= speed * speed else 2.0 * math.sqrt(way / acc)


def move_s(start: Pose, target: Pose, speed_mm_s: float, acc_mm_s2: float, limits: Limits) -> float:
    """One straight line, rest to rest, its speed capped where the tool turns; a turn on the spot is read in rad."""
    travel_mm, turn_deg = _apart(start, target)
    if travel_mm < IN_PLACE_MM and turn_deg > 0.01:
        return trapezoid_s(math.radians(turn_deg), speed_mm_s / 1e3, acc_mm_s2 / 1e3)
    if turn_deg > 0.01:
        speed_mm_s = limits.turn_capped(start, target, speed_mm_s)
    return trapezoid_s(travel_mm, speed_mm_s, acc_mm_s2)


def way_s(start: Pose, way: Way, acc_mm_s2: float, limits: Limits) -> float:
    """Poses passed without a halt: each line at its own speed, one ramp up and one down. Corners slow nothing here."""
    total_s, before = way.speed_mm_s / acc_mm_s2, start
    for pose in way.poses:
        total_s += math.dist(before.position_mm, pose.position_mm) / limits.turn_capped(before, pose, way.speed_mm_s)
        before = pose
    return total_s


def _apart(a: Pose, b: Pose) -> tuple[float, float]:
    """(mm, deg) between two poses: `drivers.geometry.distance` for the ten thousands of moves of a long plan."""
    cosine = abs(sum(p * q for p, q in zip(a.quaternion, b.quaternion, strict=True)))
    return math.dist(a.position_mm, b.position_mm), math.degrees(2.0 * math.acos(min(1.0, cosine)))


def step_s(config: RigConfig, here: Pose, moves: StepMoves) -> tuple[float, Pose]:
    """(seconds, where the arm is then)."""
    limits, acc_mm_s2 = limits_of(config), config.motion.acc_mm_s2
    total_s = moves.dwell_s + moves.captures * (config.camera.latency_ms / 1e3 + FRAME_S)
    for part in moves.parts:
        match part:
            case Move():
                took_s = move_s(here, part.target, part.speed_mm_s, acc_mm_s2, limits)
                here = part.target
            case Way():
                took_s = way_s(here, part, acc_mm_s2, limits)
                here = part.poses[-1]
            case Room():
                # Once down: how often a measured touch comes down is not known before.
                took_s = move_s(here, part.poses[0], part.speed_mm_s, acc_mm_s2, limits)
                here = part.poses[0]
        total_s += took_s + SETTLE_S
    return total_s, here
