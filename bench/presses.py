"""How many simulated presses a second the whole stack makes when the loopback clock runs as fast as it can."""

from __future__ import annotations

import json
import random
import time

from bench.harness import BenchError, Result
from bench.processes import Process
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import make_robot
from brushloop.collect.rig.paper import to_base
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.clock import HostClock
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec

HEIGHTS_MM = tuple(range(11, 21))
TILTS_DEG = (0.0, 5.0, 10.0)
PRESSES_PER_DIP = 2
PLACE_MM = (120.0, 80.0)
"""On the sheet, the same for every press."""
CLEARANCE_MM = 8.0

Moves = list[tuple[Pose, float]]
"""Where to and how fast, in mm/s."""


async def measure(rig: RigConfig, controller: Process, rate: float, n: int, seed: int, conditions: str) -> list[Result]:
    """Approach, tilt, descend, lift, through the driver; beside the brush alone, without arm and wire.

    Dips are done between presses and not timed. Raises BenchError unless the controller counts every press, inked.
    """
    rng = random.Random(seed)
    wanted = [(float(rng.choice(HEIGHTS_MM)), rng.choice(TILTS_DEG)) for _ in range(n)]
    brush = Brush(BrushSpec())
    robot = make_robot(rig, HostClock(), lambda _text: None)
    ours_s = brush_s = 0.0
    before = len(json.loads(controller.ask()))
    await robot.connect()
    try:
        await robot.enable()
        # The first press at each depth and tilt solves the spine; neither side is timed for that.
        for measured in (False, True):
            for index, (depth_mm, tilt_deg) in enumerate(wanted if measured else sorted(set(wanted))):
                if index % PRESSES_PER_DIP == 0:
                    await _carry_out(robot, dip(rig), rig)
                moves = press(rig, depth_mm, tilt_deg)
                began_s = time.perf_counter()
                await _carry_out(robot, moves, rig)
                pressed_s = time.perf_counter()
                brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=index)
                if measured:
                    ours_s += pressed_s - began_s
                    brush_s += time.perf_counter() - pressed_s
    finally:
        await robot.close()
    made = json.loads(controller.ask())[before:]
    expected = n + len(set(wanted))
    if len(made) != expected or not all(ink_load > 0.0 for _, ink_load in made):
        raise BenchError(f"{expected} inked presses were asked for, the sheet has {len(made)}")
    conditions = f"{len(press(rig, 11.0, 0.0))} moves each, dips not timed, loopback clock at {rate:g} x; {conditions}"
    peer = "the simulated brush alone, without arm and wire"
    return [Result("presses", n / ours_s, "presses/s", peer, brush_s / ours_s, n, seed, conditions)]


def press(rig: RigConfig, depth_mm: float, tilt_deg: float) -> Moves:
    """The moves of a press in a protocol: over the place, down, tilt, touch, press, lift, up."""
    motion, touch_mm = rig.motion, rig.paper.touch_z_mm
    x_mm, y_mm = to_base(rig.paper, *PLACE_MM)

    def pose(z_mm: float, tilt: float) -> Pose:
        return brush_pose(x_mm, y_mm, z_mm, heading_deg=rig.paper.yaw_deg, tilt_deg=tilt)

    fast, slow = motion.travel_speed_mm_s, motion.press_speed_mm_s
    return [
        (pose(motion.safe_z_mm, 0.0), fast),
        (pose(touch_mm + CLEARANCE_MM, 0.0), fast),
        (pose(touch_mm + CLEARANCE_MM, tilt_deg), slow),
        (pose(touch_mm, tilt_deg), slow),
        (pose(touch_mm - depth_mm, tilt_deg), slow),
        (pose(touch_mm + CLEARANCE_MM, tilt_deg), slow),
        (pose(motion.safe_z_mm, 0.0), fast),
    ]


def dip(rig: RigConfig) -> Moves:
    """Into the well and out again."""
    x_mm, y_mm = to_base(rig.paper, *rig.ink.well_mm)
    fast, slow = rig.motion.travel_speed_mm_s, rig.motion.press_speed_mm_s
    heights = ((rig.motion.safe_z_mm, fast), (rig.ink.dip_z_mm, slow), (rig.motion.safe_z_mm, fast))
    return [(brush_pose(x_mm, y_mm, z_mm, heading_deg=rig.paper.yaw_deg), speed) for z_mm, speed in heights]


async def _carry_out(robot: AuboArcs, moves: Moves, rig: RigConfig) -> None:
    for target, speed_mm_s in moves:
        await robot.move(target, speed_mm_s=speed_mm_s, acc_mm_s2=rig.motion.acc_mm_s2)
