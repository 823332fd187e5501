"""Parameter names of ARCS methods in the maker's order: what turns named params into positional ones and back."""

from __future__ import annotations

from collections.abc import Mapping

PARAMETERS: dict[str, tuple[str, ...]] = {
    "IoControl.getConfigurableDigitalInput": ("index",),
    "IoControl.getConfigurableDigitalOutput": ("index",),
    "IoControl.getStandardAnalogInput": ("index",),
    "IoControl.getStandardAnalogInputDomain": ("index",),
    "IoControl.getStandardAnalogOutput": ("index",),
    "IoControl.getStandardAnalogOutputDomain": ("index",),
    "IoControl.getStandardDigitalInput": ("index",),
    "IoControl.getStandardDigitalOutput": ("index",),
    "IoControl.getToolAnalogInput": ("index",),
    "IoControl.getToolAnalogInputDomain": ("index",),
    "IoControl.getToolAnalogOutput": ("index",),
    "IoControl.getToolAnalogOutputDomain": ("index",),
    "IoControl.getToolDigitalInput": ("index",),
    "IoControl.getToolDigitalOutput": ("index",),
    "IoControl.isToolIoInput": ("index",),
    "IoControl.setConfigurableDigitalOutput": ("index", "value"),
    "IoControl.setConfigurableDigitalOutputPulse": ("index", "value", "duration"),
    "IoControl.setStandardAnalogInputDomain": ("index", "domain"),
    "IoControl.setStandardAnalogOutput": ("index", "value"),
    "IoControl.setStandardAnalogOutputDomain": ("index", "domain"),
    "IoControl.setStandardDigitalOutput": ("index", "value"),
    "IoControl.setStandardDigitalOutputPulse": ("index", "value", "duration"),
    "IoControl.setToolAnalogInputDomain": ("index", "domain"),
    "IoControl.setToolAnalogOutput": ("index", "value"),
    "IoControl.setToolAnalogOutputDomain": ("index", "domain"),
    "IoControl.setToolDigitalOutput": ("index", "value"),
    "IoControl.setToolDigitalOutputPulse": ("index", "value", "duration"),
    "IoControl.setToolIoInput": ("index", "input"),
    "IoControl.setToolVoltageOutputDomain": ("domain",),
    "MotionControl.getDuration": ("id",),
    "MotionControl.getMotionLeftTime": ("id",),
    "MotionControl.moveCircle": ("via_pose", "end_pose", "a", "v", "blend_radius", "duration"),
    "MotionControl.moveJoint": ("q", "a", "v", "blend_radius", "duration"),
    "MotionControl.moveLine": ("pose", "a", "v", "blend_radius", "duration"),
    "MotionControl.moveSpline": ("q", "a", "v", "duration"),
    "MotionControl.servoCartesian": ("pose", "a", "v", "t", "lookahead_time", "gain"),
    "MotionControl.servoJoint": ("q", "a", "v", "t", "lookahead_time", "gain"),
    "MotionControl.setCirclePathMode": ("mode",),
    "MotionControl.setServoMode": ("enable",),
    "MotionControl.setServoModeSelect": ("mode",),
    "MotionControl.setSpeedFraction": ("fraction",),
    "MotionControl.speedJoint": ("qd", "a", "t"),
    "MotionControl.speedLine": ("xd", "a", "t"),
    "MotionControl.stopJoint": ("acc",),
    "MotionControl.stopLine": ("acc", "acc_rot"),
    "MotionControl.stopMove": ("quick", "all_tasks"),
    "RegisterControl.getWatchDogAction": ("key",),
    "RegisterControl.getWatchDogTimeout": ("key",),
    "RegisterControl.setWatchDog": ("key", "timeout", "action"),
    "RobotAlgorithm.forwardKinematics": ("q",),
    "RobotAlgorithm.forwardToolKinematics": ("q",),
    "RobotAlgorithm.inverseKinematics": ("qnear", "pose"),
    "RobotAlgorithm.inverseToolKinematics": ("qnear", "pose"),
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
