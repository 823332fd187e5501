"""The methods of the loopback controller by their names on the wire."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from drivers.arcs.codes import LOOPBACK_CONTROL_BOX, MOVING_ALLOWED, ReturnCode
from drivers.geometry import to_wire
from drivers.sim.arcs_cabinet import ROBOT, SOFT_STOP_M_S2, Cabinet
from drivers.sim.kinematics import A_M, ALPHA_DEG, D_M, LIMITS_DEG, THETA_DEG

INTERFACE_VERSION = 24000
CONTROL_SOFTWARE_VERSION = 31001
OPERATIONAL_MODES = ("Disabled", "Automatic", "Manual")

Params = dict[str, Any]
Table = dict[str, Callable[[Params], Any]]


def methods(cabinet: Cabinet) -> Table:
    """Every method that the controller knows; each takes named params and returns what goes on the wire."""
    table = _of_the_robot(cabinet) | _motion(cabinet) | cabinet.io.methods()
    return {f"{ROBOT}.{name}": method for name, method in table.items()} | _of_the_controller(cabinet)


def _of_the_controller(cabinet: Cabinet) -> Table:
    return {
        "SystemInfo.getInterfaceVersionCode": lambda _: INTERFACE_VERSION,
        "SystemInfo.getControlSoftwareVersionCode": lambda _: CONTROL_SOFTWARE_VERSION,
        "getRobotNames": lambda _: [ROBOT],
        "getAxisNames": lambda _: [],
        "RuntimeMachine.abort": lambda _: cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2),
        # Stops a program; motion that clients asked for is none of its business.
        "RuntimeMachine.stop": lambda _: ReturnCode.OK,
        "RuntimeMachine.pause": lambda _: cabinet.hold(),
        "RuntimeMachine.resume": lambda _: cabinet.resume(),
        "RuntimeMachine.getRuntimeState": lambda _: runtime_state(cabinet),
        "RuntimeMachine.getStatus": lambda _: runtime_state(cabinet),
        "RegisterControl.setWatchDog": lambda p: cabinet.set_watchdog(
            str(p["key"]), float(p["timeout"]), int(p["action"])
        ),
        "RegisterControl.getWatchDogAction": lambda p: cabinet.watchdogs.get(str(p["key"]), (0.0, 0))[1],
        "RegisterControl.getWatchDogTimeout": lambda p: cabinet.watchdogs.get(str(p["key"]), (0.0, 0))[0],
    }


def _of_the_robot(cabinet: Cabinet) -> Table:
    power = cabinet.power
    return {
        "RobotConfig.getRobotType": lambda _: "aubo_i5",
        "RobotConfig.getRobotSubType": lambda _: "aubo_i5_11",
        "RobotConfig.getControlBoxType": lambda _: LOOPBACK_CONTROL_BOX,
        "RobotConfig.getName": lambda _: ROBOT,
        "RobotConfig.getDof": lambda _: 6,
        "RobotConfig.getCycletime": lambda _: 0.005,
        "RobotConfig.getJointMaxPositions": lambda _: [math.radians(v) for v in LIMITS_DEG],
        "RobotConfig.getJointMinPositions": lambda _: [-math.radians(v) for v in LIMITS_DEG],
        "RobotConfig.getKinematicsParam": lambda _: {
            "a": A_M,
            "alpha": [math.radians(v) for v in ALPHA_DEG],
            "beta": [0.0] * 6,
            "d": D_M,
            "theta": [math.radians(v) for v in THETA_DEG],
        },
        "RobotConfig.setTcpOffset": lambda p: _set_tcp_offset(cabinet, p),
        "RobotConfig.getTcpOffset": lambda _: cabinet.tcp_offset,
        "RobotConfig.setPayload": lambda p: _set_payload(cabinet, p),
        "RobotConfig.getPayload": lambda _: cabinet.payload,
        "RobotConfig.setCollisionLevel": lambda p: _set_collision_level(cabinet, p),
        "RobotConfig.getCollisionLevel": lambda _: cabinet.collision_level,
        "RobotManage.poweron": lambda _: power.power_on(),
        "RobotManage.startup": lambda _: power.start_up(),
        "RobotManage.poweroff": lambda _: cabinet.power_off(),
        "RobotManage.getOperationalMode": lambda _: cabinet.operational_mode,
        "RobotManage.setOperationalMode": lambda p: _set_operational_mode(cabinet, p),
        "RobotManage.setUnlockProtectiveStop": lambda _: power.unlock(),
        "RobotManage.restartInterfaceBoard": lambda _: power.restart_interface_board(),
        "RobotState.getRobotModeType": lambda _: power.mode.value,
        "RobotState.getSafetyModeType": lambda _: power.safety.value,
        "RobotState.isPowerOn": lambda _: power.on,
        "RobotState.isCollisionOccurred": lambda _: power.collision,
        "RobotState.isWithinSafetyLimits": lambda _: power.safety in MOVING_ALLOWED,
        "RobotState.isSteady": lambda _: cabinet.motion.steady(cabinet.now_s()),
        "RobotState.getTcpPose": lambda _: to_wire(cabinet.world.tool()),
        "RobotState.getToolPose": lambda _: to_wire(cabinet.flange()),
        "RobotState.getActualTcpOffset": lambda _: cabinet.tcp_offset,
        "RobotState.getJointPositions": lambda _: cabinet.joints(),
        "RobotState.getTcpForce": lambda _: cabinet.force(),
        "RobotAlgorithm.forwardKinematics": lambda p: cabinet.fk(p["q"], tip=True),
        "RobotAlgorithm.forwardToolKinematics": lambda p: cabinet.fk(p["q"], tip=False),
        "RobotAlgorithm.inverseKinematics": lambda p: cabinet.ik(_floats(p["qnear"], 6), p["pose"]),
        "Trace.peek": lambda p: _peek(cabinet, int(p["num"]), int(p.get("last_time", 0))),
        "Trace.textmsg": lambda _: ReturnCode.OK,
    }


def _motion(cabinet: Cabinet) -> Table:
    motion, now_s = cabinet.motion, cabinet.now_s
    return {
        "MotionControl.getExecId": lambda _: motion.exec_id(now_s()),
        "MotionControl.getQueueSize": lambda _: _queue_size(cabinet),
        "MotionControl.getTrajectoryQueueSize": lambda _: _queue_size(cabinet),
        "MotionControl.moveLine": cabinet.move_line,
        "MotionControl.moveJoint": cabinet.move_joint,
        "MotionControl.stopLine": lambda p: cabinet.stop(float(p["acc"]), float(p["acc_rot"])),
        "MotionControl.stopJoint": lambda p: cabinet.stop(SOFT_STOP_M_S2, float(p["acc"])),
        "MotionControl.clearPath": lambda _: cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2),
        "MotionControl.stopMove": lambda _: cabinet.hold(),
        "MotionControl.startMove": lambda _: cabinet.resume(),
        "MotionControl.setSpeedFraction": lambda p: cabinet.set_speed_fraction(float(p["fraction"])),
        "MotionControl.getSpeedFraction": lambda _: motion.fraction,
    }


def runtime_state(cabinet: Cabinet) -> str:
    """Motion from a client runs with the runtime Stopped."""
    return "Paused" if cabinet.motion.held else "Stopped"


def _queue_size(cabinet: Cabinet) -> int:
    cabinet.motion.advance(cabinet.now_s())
    return cabinet.motion.size


def _floats(values: Any, count: int) -> list[float]:
    floats = [float(v) for v in values]
    if len(floats) != count or not all(math.isfinite(v) for v in floats):
        raise ValueError(f"expected {count} finite numbers, got {values!r}")
    return floats


def _set_tcp_offset(cabinet: Cabinet, p: Params) -> int:
    offset = [float(v) for v in p["offset"]]
    if len(offset) != 6 or not all(math.isfinite(v) for v in offset):
        return -ReturnCode.INVALID_ARGUMENT
    cabinet.tcp_offset = offset
    return ReturnCode.OK


def _set_payload(cabinet: Cabinet, p: Params) -> int:
    mass_kg, inertia = float(p["m"]), [float(v) for v in p["inertia"]]
    if not 0.0 <= mass_kg <= 5.0 or len(inertia) not in (6, 9):
        return -ReturnCode.INVALID_ARGUMENT
    cabinet.payload = [mass_kg, _floats(p["cog"], 3), _floats(p["aom"], 3), inertia]
    return ReturnCode.OK


def _set_collision_level(cabinet: Cabinet, p: Params) -> int:
    level = int(p["level"])
    if not 0 <= level <= 9:
        return -ReturnCode.INVALID_ARGUMENT
    cabinet.collision_level = level
    return ReturnCode.OK


def _set_operational_mode(cabinet: Cabinet, p: Params) -> int:
    if p["mode"] not in OPERATIONAL_MODES:
        return -ReturnCode.INVALID_ARGUMENT
    cabinet.operational_mode = str(p["mode"])
    return ReturnCode.OK


def _peek(cabinet: Cabinet, count: int, after: int) -> list[dict[str, Any]]:
    return [m for m in cabinet.messages if m["timestamp"] > after][-count:] if count > 0 else []
