"""Asks the controller whether it can reach every pose. Nothing is powered, set or moved."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from collect.errors import ConfigError
from collect.rig.config import RigConfig
from drivers.arcs.controller import Controller
from drivers.arcs.robot import AUBOPE_PORT
from drivers.arcs.rpc import RpcConnection, open_arcs
from drivers.errors import ProtocolViolation
from drivers.geometry import to_wire
from drivers.samples import Pose

DEVICE = "robot"


async def ask_reach(rig_path: Path, config: RigConfig, poses: Iterable[tuple[Pose, float, str]]) -> int:
    """How many different poses the controller finds joints for, each sought near those of the one before.

    The tool that is set on the controller stays as it is: every pose is turned into one for that tool. Raises
    `ConfigError` naming the first pose that is out of reach, and `DeviceError`.
    """
    robot = config.robot
    controller = Controller(RpcConnection(robot.host, robot.port, framing=robot.framing))
    try:
        await open_arcs(controller.connection, AUBOPE_PORT)
        await controller.connection.login()
        [controller.robot, *_] = await controller.robot_names()
        offset = await _tool(controller)
        near = await controller.joint_positions()
        asked: set[Pose] = set()
        for pose, _, where in poses:
            if pose in asked:
                continue
            asked.add(pose)
            wire = to_wire(_for_tool(pose, robot.tcp_offset_mm, offset))
            found = await _joints(controller, wire, near)
            if found is None:
                raise ConfigError(
                    rig_path,
                    "paper",
                    f"the controller finds no joints for {where}: "
                    f"x = {pose.x_mm:.1f}, y = {pose.y_mm:.1f}, z = {pose.z_mm:.1f} mm, "
                    "counted with robot.tcp_offset_mm. Nearer to the arm, or with another yaw, it may",
                )
            near = found
        return len(asked)
    finally:
        await controller.connection.close()


async def _joints(controller: Controller, wire: list[float], near: list[float]) -> list[float] | None:
    match await controller.ask("RobotAlgorithm.inverseKinematics", qnear=near, pose=wire):
        case [list(joints), 0]:  # pyright: ignore[reportUnknownVariableType]
            return _six("inverseKinematics", joints)
        case [_, int()]:
            return None
        case other:
            raise ProtocolViolation(DEVICE, "inverseKinematics", f"no return code: {other!r}")


async def _tool(controller: Controller) -> list[float]:
    """The offset that the controller counts with: x, y, z in m, rx, ry, rz in rad."""
    return _six("getTcpOffset", await controller.ask("RobotConfig.getTcpOffset"))


def _six(op: str, values: Any) -> list[float]:
    try:
        numbers = [float(v) for v in values]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 6:
        raise ProtocolViolation(DEVICE, op, f"expected six numbers, got {values!r}")
    return numbers


def _for_tool(tip: Pose, ours_mm: tuple[float, float, float], theirs: list[float]) -> Pose:
    """Where the controller's own tool would be while our tip is at `tip`: tip * ours^-1 * theirs."""
    at = Rotation.from_quat(tip.quaternion)
    x, y, z, rx, ry, rz = theirs
    shift_mm = at.apply([1e3 * v - o for v, o in zip((x, y, z), ours_mm, strict=True)])
    turned = at * Rotation.from_euler("ZYX", [rz, ry, rx])
    qx, qy, qz, qw = (float(v) for v in turned.as_quat())
    px, py, pz = (p + float(s) for p, s in zip(tip.position_mm, shift_mm, strict=True))
    return Pose(px, py, pz, qx, qy, qz, qw)
