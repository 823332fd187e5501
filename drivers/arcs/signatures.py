"""Parameter names of ARCS methods in the maker's order: what turns named params into positional ones and back."""

from __future__ import annotations

from collections.abc import Mapping

PARAMETERS: dict[str, tuple[str, ...]] = {
    "IoControl.getStandardDigitalInput": ("index",),
    "IoControl.getStandardDigitalOutput": ("index",),
    "IoControl.getToolDigitalInput": ("index",),
    "IoControl.getToolDigitalOutput": ("index",),
    "IoControl.setStandardDigitalOutput": ("index", "value"),
    "IoControl.setToolDigitalOutput": ("index", "value"),
    "IoControl.setToolIoInput": ("index", "input"),
    "IoControl.setToolVoltageOutputDomain": ("domain",),
    "MotionControl.moveJoint": ("q", "a", "v", "blend_radius", "duration"),
    "MotionControl.moveLine": ("pose", "a", "v", "blend_radius", "duration"),
    "MotionControl.setSpeedFraction": ("fraction",),
    "MotionControl.stopJoint": ("acc",),
    "MotionControl.stopLine": ("acc", "acc_rot"),
    "MotionControl.stopMove": ("quick", "all_tasks"),
    "RegisterControl.getWatchDogAction": ("key",),
    "RegisterControl.getWatchDogTimeout": ("key",),
    "RegisterControl.setWatchDog": ("key", "timeout", "action"),
    "RobotAlgorithm.forwardKinematics": ("q",),
    "RobotAlgorithm.forwardToolKinematics": ("q",),
    "RobotAlgorithm.inverseKinematics": ("qnear", "pose"),
    "RobotConfig.getKinematicsParam": ("real",),
    "RobotConfig.setCollisionLevel": ("level",),
    "RobotConfig.setPayload": ("m", "cog", "aom", "inertia"),
    "RobotConfig.setTcpOffset": ("offset",),
    "RobotManage.setOperationalMode": ("mode",),
    "Trace.peek": ("num", "last_time"),
    "Trace.textmsg": ("msg",),
}
"""By `Class.method`, without the robot's name. A method that is not here takes nothing."""


def parameters(method: str) -> tuple[str, ...]:
    """The parameter names of `method`, with or without the robot's name in front."""
    return PARAMETERS.get(".".join(method.split(".")[-2:]), ())


def positional(method: str, params: Mapping[str, object]) -> list[object]:
    """The values in the maker's order. Raises ValueError for a name that is missing or too many."""
    names = parameters(method)
    if set(names) != set(params):
        raise ValueError(f"{method} takes {names}, got {tuple(params)}")
    return [params[name] for name in names]


def named(method: str, values: list[object]) -> dict[str, object]:
    """The values by name. Raises ValueError for the wrong number of them."""
    return dict(zip(parameters(method), values, strict=True))
