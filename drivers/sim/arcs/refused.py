"""Methods of the maker's interface that the loopback controller knows and does not simulate.

They answer the controller's own NOT_IMPLEMENTED. Methods whose answer is no return code are unknown here (-32601).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.arcs.codes import ReturnCode

ROBOT_METHODS: dict[str, tuple[str, ...]] = {
    "ForceControl": (
        *("fcEnable", "setTargetForce", "setDynamicModel", "toolContact", "softFloatEnable", "setSoftFloatParams"),
        *("speedChangeEnable", "speedChangeTune", "setDamping", "resetDamping", "setLpFilter", "resetLpFilter"),
        *("setCondActive", "setCondAdvanced", "setCondCylinder", "setCondDistance", "setCondForce", "setCondOrient"),
        *("setCondPlane", "setCondSphere", "setCondTcpSpeed", "setSupvForce", "setSupvOrient", "setSupvPosBox"),
        *("setSupvPosCylinder", "setSupvPosSphere", "setSupvReoriSpeed", "setSupvTcpSpeed"),
    ),
    "IoControl": (
        *("setStandardDigitalInputAction", "setConfigurableDigitalInputAction", "setToolDigitalInputAction"),
        *("setStandardDigitalOutputRunstate", "setConfigurableDigitalOutputRunstate", "setToolDigitalOutputRunstate"),
        *("setStandardAnalogOutputRunstate", "setToolAnalogOutputRunstate", "setDigitalInputActionDefault"),
        *("setDigitalOutputRunstateDefault", "setEncDecoderType", "setEncTickCount", "unwindEncDeltaTickCount"),
    ),
    "MotionControl": (
        *("pathBufferAlloc", "pathBufferAppend", "pathBufferEval", "pathBufferFree", "movePathBuffer"),
        *("moveCircle2", "moveSpiral", "moveIntersection", "moveProcess", "setEqradius", "setLookAheadSize"),
        *("pathOffsetEnable", "pathOffsetSet", "pathOffsetLimits", "pathOffsetCoordinate", "jointOffsetEnable"),
        *("jointOffsetSet", "servoJointWithAxes", "servoCartesianWithAxes", "trackJoint", "trackCartesian"),
        *("followJoint", "followLine", "weaveStart", "weaveEnd", "storePath", "restoPath", "setWorkObjectHold"),
        *("conveyorTrackLine", "conveyorTrackCircle", "conveyorTrackStop", "speedFractionCritical"),
        *("resumeMoveJoint", "resumeMoveLine", "resumeSpeedJoint", "resumeSpeedLine", "resumeStopJoint"),
        *("resumeStopLine", "setFuturePointSamplePeriod"),
    ),
    "RobotConfig": (
        *("setGravity", "setMountingPose", "setHomePosition", "setCollisionStopType", "selectTcpForceSensor"),
        *("setTcpForceOffset", "setTcpForceSensorPose", "selectBaseForceSensor", "setBaseForceOffset"),
        *("setToolInertial", "setFreedriveDamp", "setSlowDownFraction", "setPersistentParameters"),
        *("setKinematicsCompensate", "setHardwareCustomParameters", "setRobotZero", "confirmSafetyParameters"),
        *("firmwareUpdate",),
    ),
    "RobotManage": (
        *("freedrive", "backdrive", "handguideMode", "exitHandguideMode", "setSim", "setLinkModeEnable"),
        *("startRecord", "stopRecord", "pauseRecord"),
    ),
}
CABINET_METHODS: dict[str, tuple[str, ...]] = {
    "RuntimeMachine": (
        *("loadProgram", "runProgram", "start", "step", "gotoLine", "setPlanContext", "newTask", "deleteTask"),
        *("setBreakPoint", "removeBreakPoint", "clearBreakPoints"),
    ),
}


def refusals(methods: dict[str, tuple[str, ...]]) -> dict[str, Callable[[dict[str, Any]], Any]]:
    """By `Class.method`."""
    return {f"{owner}.{name}": _refuse for owner, names in methods.items() for name in names}


def _refuse(_: dict[str, Any]) -> int:
    return -ReturnCode.NOT_IMPLEMENTED
