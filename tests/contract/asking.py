"""How far and how fast the contract moves an arm, and the question whether it may.

It goes a few millimetres straight up, slowly, and back.
"""

from __future__ import annotations

import asyncio
import dataclasses
import sys

import pytest

from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import make_robot, sole_driver
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Identity, Pose
from brushloop.drivers.host import HostClock

LIFT_MM = 5.0
"""No test sends the tip higher than this above where it stood, lower than that, or sideways."""
SPEED_MM_S = 10.0
SLOW_MM_S = 2.0
"""For a move that is stopped on its way."""
ACC_MM_S2 = 100.0
SAME_PLACE_MM = 0.5
"""Somebody moved the arm between two tests where it stands farther than this from where the first began."""


@dataclasses.dataclass(frozen=True, slots=True)
class Enabled:
    """An arm that may move, where it stands, and the highest pose that a test may send it to."""

    robot: AuboArcs
    start: Pose
    top: Pose


def raised(pose: Pose, by_mm: float) -> Pose:
    """The same attitude, straight above."""
    return dataclasses.replace(pose, z_mm=pose.z_mm + by_mm)


QUESTION = "Keep a hand at the emergency stop. May the arm move? [y/N] "


def permission_refused(config: pytest.Config, rig: RigConfig, tests: int) -> str | None:
    """Tell and ask; None for a yes, else why no test may move the arm. Raises what connecting raises."""
    with sole_driver(rig.robot.host, rig.robot.port):
        identity, where, state = asyncio.run(_look(rig))
    capture = config.pluginmanager.getplugin("capturemanager")
    assert capture is not None
    capture.suspend_global_capture(in_=True)
    try:
        sys.stdout.write(_announcement(rig, identity, where, state, tests))
        if not sys.stdin.isatty():
            sys.stdout.write("No terminal to ask on: nothing moves.\n")
            return "--rig: no terminal to ask on whether the arm may move"
        sys.stdout.write(QUESTION)
        sys.stdout.flush()
        answer = sys.stdin.readline().strip().lower()
    finally:
        # Back to how pytest has it while it collects: output goes through, input is cut off.
        capture.resume_global_capture()
        capture.suspend_global_capture(in_=False)
    return None if answer in ("y", "yes") else f"--rig: the answer to whether the arm may move was {answer or 'no'!r}"


async def _look(rig: RigConfig) -> tuple[Identity, Pose, tuple[str, str]]:
    """Connect and ask; powers, sets and moves nothing."""
    robot = make_robot(rig, HostClock(), lambda _text: None)
    try:
        return await robot.connect(), await robot.where(), await robot.modes()
    finally:
        await robot.close()


def _announcement(rig: RigConfig, identity: Identity, where: Pose, modes: tuple[str, str], tests: int) -> str:
    robot, limits = rig.robot, rig.robot.limits
    what = "the loopback rig, simulated" if identity.simulated else "A REAL ARM"
    x, y, z = where.position_mm
    return f"""
{tests} tests are about to power an arm and move it.
  robot    {identity.model}, {identity.firmware}: {what}
  address  {robot.host}:{robot.port}, framing {robot.framing}; rig {rig.name!r}
  state    robot mode {modes[0]}, safety mode {modes[1]}
  tip      x {x:.1f}, y {y:.1f}, z {z:.1f} mm with the tool that the controller has now; the rig's tool is set first
  box      straight up by at most {LIFT_MM:g} mm from where the tip stands, and back; not lower, not sideways, no turn
  step     {LIFT_MM:g} mm at most, at {SPEED_MM_S:g} mm/s and {ACC_MM_S2:g} mm/s2 at most
  limits   z {limits.z_mm[0]:g} to {limits.z_mm[1]:g} mm with that tool; the driver checks each target before it is sent
"""
