"""Estimates of a plan's time and ink, and of how far a mark is likely to reach."""

from __future__ import annotations

import math
from dataclasses import dataclass

from brushloop.collect.motion.moves import Move, Room, Way
from brushloop.collect.planning.walk import StepMoves
from brushloop.collect.rig.config import BrushConfig, RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.drivers.devices import Pose
from brushloop.drivers.limits import Limits
from brushloop.sessions.records import Condition

SETTLE_S = 0.12
"""Time from the end of a ramp to the next command: the controller's lag in reporting rest, half a poll, the calls.
Measured on the loopback rig; for a real controller it is not known."""
FRAME_S = 0.1
"""Period of 10 frames a second: a photograph is the second frame that begins after the arm rests."""
IN_PLACE_MM = 1.0
"""For a line shorter than this, ARCS reads the speed as that of the rotation: mm/s as thousandths of rad/s."""
OMITTED = (
    "connecting, power on, doses of ink, touches that measure the height, quality checks, writing to disk, "
    "sheet changes, pauses, and repeated presses"
)


def trapezoid_s(way: float, speed: float, acc: float) -> float:
    """Seconds of a trapezoidal speed profile from rest to rest; triangular if the speed is not reached."""
    return way / speed + speed / acc if way * acc >= speed * speed else 2.0 * math.sqrt(way / acc)


def move_s(start: Pose, target: Pose, speed_mm_s: float, acc_mm_s2: float, limits: Limits) -> float:
    """Seconds of a straight line, rest to rest, slower where the tool turns; a turn on the spot counts in rad."""
    travel_mm, turn_deg = _apart(start, target)
    if travel_mm < IN_PLACE_MM and turn_deg > 0.01:
        return trapezoid_s(math.radians(turn_deg), speed_mm_s / 1e3, acc_mm_s2 / 1e3)
    if turn_deg > 0.01:
        speed_mm_s = limits.turn_capped(start, target, speed_mm_s)
    return trapezoid_s(travel_mm, speed_mm_s, acc_mm_s2)


def way_s(start: Pose, way: Way, acc_mm_s2: float, limits: Limits) -> float:
    """Seconds through poses without a halt: each line at its speed, one ramp up and one down; corners cost nothing."""
    total_s, before = way.speed_mm_s / acc_mm_s2, start
    for pose in way.poses:
        total_s += math.dist(before.position_mm, pose.position_mm) / limits.turn_capped(before, pose, way.speed_mm_s)
        before = pose
    return total_s


def _apart(a: Pose, b: Pose) -> tuple[float, float]:
    """(mm, deg) between two poses: `drivers.geometry.distance` for the tens of thousands of moves of a long plan."""
    cosine = abs(sum(p * q for p, q in zip(a.quaternion, b.quaternion, strict=True)))
    return math.dist(a.position_mm, b.position_mm), math.degrees(2.0 * math.acos(min(1.0, cosine)))


def step_s(config: RigConfig, here: Pose, moves: StepMoves) -> tuple[float, Pose]:
    """(seconds of a step that begins at `here`, pose at its end)."""
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
                # One descent: the number of descents of a measured touch is not known beforehand.
                took_s = move_s(here, part.poses[0], part.speed_mm_s, acc_mm_s2, limits)
                here = part.poses[0]
        total_s += took_s + SETTLE_S
    return total_s, here


HELD_SHARE = 0.3
"""Share of a wet bundle's volume that is ink between the hairs. Assumed: weigh a dipped brush to know it."""


@dataclass(frozen=True, slots=True)
class InkNeed:
    """Upper estimate of the ink, and what it is based on."""

    ml: float
    why: str


def bundle_ml(brush: BrushConfig) -> float:
    """Volume of the bundle as a cone of its largest radius and its length."""
    return math.pi * brush.radius_mm**2 * brush.length_mm / 3.0 / 1e3


def ink_need(config: RigConfig, dips: int) -> InkNeed:
    """Count a full load per dip, as if each mark emptied the brush; for a pump that doses by count, its doses."""
    device = config.ink.device
    if device is not None and (doses_ml := device.doses_ml(dips)) is not None:
        return InkNeed(doses_ml, f"what the {device.kind} doses in {dips} dips")
    load_ml = HELD_SHARE * bundle_ml(config.brush)
    return InkNeed(
        dips * load_ml,
        f"at most: every dip takes {load_ml:.2f} ml, {HELD_SHARE:.0%} of the bundle's volume (assumed)",
    )


@dataclass(frozen=True, slots=True)
class Reach:
    """How far a mark reaches from its zero-touch point: along the heading, against it, and to either side."""

    ahead_mm: float
    behind_mm: float
    side_mm: float


def reach_of(brush: BrushConfig, condition: Condition) -> Reach:
    """Estimate by the closed-form stroke model (CCD-BSM), Eq. 1-5, lambda = pi: good for a warning, not a measurement.

    theta = atan(R / L), O3A = H (tan a - tan(a - theta)), O4O3 = H / cos(a - theta) + O3A, O3C = H R / (L cos a).
    The mark lies from -O4O3 to O3A, pi O3C to each side.
    """
    alpha, theta = math.radians(condition.tilt_deg), math.atan2(brush.radius_mm, brush.length_mm)
    depth_mm = max(condition.depth_mm, 0.0)
    o3a = depth_mm * (math.tan(alpha) - math.tan(alpha - theta))
    o4o3 = depth_mm / math.cos(alpha - theta) + o3a
    o3c = depth_mm * brush.radius_mm / (brush.length_mm * math.cos(alpha))
    return Reach(o3a, o4o3, math.pi * o3c)
