"""Joint moves and reach, as the controller computes them: a nominal table would be most of a millimetre wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from drivers.arcs.controller import Controller
from drivers.arcs.framing import numbers
from drivers.arcs.rpc import DEVICE
from drivers.errors import LimitExceeded, ProtocolViolation
from drivers.geometry import distance, from_wire, to_wire
from drivers.limits import Limits
from drivers.samples import Pose

SAMPLE_RAD = math.radians(3.0)
"""The path is checked at steps of the joint that turns most."""
SPEED_RAD_S = (0.001, 3.2)
ACC_RAD_S2 = (0.01, 32.0)
JOINT_RAD = (-2.0 * math.pi, 2.0 * math.pi)


async def joint_positions(controller: Controller) -> list[float]:
    """Six joints in rad. Raises `ProtocolViolation`."""
    return _joints("getJointPositions", await controller.ask("RobotState.getJointPositions"))


async def forward(controller: Controller, joints: Sequence[float]) -> Pose:
    """The tip for these joints, by the controller. Raises `ProtocolViolation` where it has no answer."""
    match await controller.ask("RobotAlgorithm.forwardKinematics", q=list(joints)):
        case [list(pose), 0]:  # pyright: ignore[reportUnknownVariableType]
            try:
                return from_wire(numbers(pose, 6))  # pyright: ignore[reportUnknownArgumentType]
            except ValueError as error:
                raise ProtocolViolation(DEVICE, "forwardKinematics", str(error)) from None
        case other:
            raise ProtocolViolation(DEVICE, "forwardKinematics", f"no pose: {other!r}")


async def reachable(controller: Controller, pose: Pose) -> bool:
    """Whether the controller finds joints for a tip pose, near those of now."""
    near = await joint_positions(controller)
    match await controller.ask("RobotAlgorithm.inverseKinematics", qnear=near, pose=to_wire(pose)):
        case [_, int(code)]:
            return code == 0
        case other:
            raise ProtocolViolation(DEVICE, "inverseKinematics", f"no return code: {other!r}")


async def checked_path(
    controller: Controller, limits: Limits, target: Sequence[float], speed_rad_s: float, acc_rad_s2: float
) -> tuple[Pose, float]:
    """(where the tip will end, seconds of the move at speed), with the whole path within the limits.

    A path that is straight in joints is an arc in space: it may leave the box between two ends that lie inside, so the
    controller is asked for poses along the way. Raises `LimitExceeded`; nothing has been sent that moves.
    """
    if len(target) != 6:
        raise ValueError(f"six joints, not {len(target)}")
    for field, value, (low, high), unit in (
        ("joint speed", speed_rad_s, SPEED_RAD_S, "rad/s"),
        ("joint acceleration", acc_rad_s2, ACC_RAD_S2, "rad/s2"),
        *((f"joint {i + 1}", q, JOINT_RAD, "rad") for i, q in enumerate(target)),
    ):
        if not low <= value <= high:
            raise LimitExceeded(DEVICE, field, value, low, high, unit)
    start = await joint_positions(controller)
    turn_rad = max(abs(b - a) for a, b in zip(start, target, strict=True))
    steps = max(1, math.ceil(turn_rad / SAMPLE_RAD))
    before = await forward(controller, start)
    for k in range(1, steps + 1):
        pose = await forward(controller, [a + (b - a) * k / steps for a, b in zip(start, target, strict=True)])
        lever_mm = distance(before, pose)[0] / (turn_rad / steps) if turn_rad > 0.0 else 0.0
        # The limits have lower ends too; a wrist that turns on the spot moves the tip by nothing.
        limits.check(
            DEVICE, pose, speed_mm_s=max(lever_mm * speed_rad_s, 0.1), acc_mm_s2=max(lever_mm * acc_rad_s2, 1.0)
        )
        before = pose
    return before, turn_rad / speed_rad_s + speed_rad_s / acc_rad_s2


def _joints(op: str, values: Any) -> list[float]:
    try:
        return numbers(values, 6)
    except ValueError as error:
        raise ProtocolViolation(DEVICE, op, str(error)) from None
