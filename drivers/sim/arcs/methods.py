"""The methods of the loopback controller by their names on the wire."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from drivers.arcs.codes import LOOPBACK_CONTROL_BOX, MOVING_ALLOWED, ReturnCode, RobotMode
from drivers.geometry import to_wire
from drivers.sim.arcs.cabinet import ROBOT, SOFT_STOP_M_S2, Cabinet
from drivers.sim.arcs.limits import tables
from drivers.sim.arcs.moves import Moves
from drivers.sim.arcs.refused import CABINET_METHODS, ROBOT_METHODS, refusals
from drivers.sim.arcs.steering import Steering

INTERFACE_VERSION = 24000
CONTROL_SOFTWARE_VERSION = 31001
SOFTWARE_VERSION = f"0.31.1-{LOOPBACK_CONTROL_BOX}"
OPERATIONAL_MODES = ("Disabled", "Automatic", "Manual")

Params = dict[str, Any]
Table = dict[str, Callable[[Params], Any]]


def methods(cabinet: Cabinet) -> Table:
    """Every method that the controller knows; each takes named params and returns what goes on the wire."""
    table = refusals(ROBOT_METHODS) | _of_the_robot(cabinet) | _of_the_state(cabinet) | tables() | cabinet.io.methods()
    table |= Moves(cabinet).methods() | Steering(cabinet).methods()
    whole = {f"{ROBOT}.{name}": method for name, method in table.items()}
    return whole | refusals(CABINET_METHODS) | _of_the_controller(cabinet)


def _of_the_controller(cabinet: Cabinet) -> Table:
    return {
        "SystemInfo.getInterfaceVersionCode": lambda _: INTERFACE_VERSION,
        "SystemInfo.getControlSoftwareVersionCode": lambda _: CONTROL_SOFTWARE_VERSION,
        "SystemInfo.getControlSoftwareFullVersion": lambda _: SOFTWARE_VERSION,
        "SystemInfo.getControlSystemTime": lambda _: int(cabinet.now_s() * 1e9),
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
        "RobotConfig.hasTcpForceSensor": lambda _: False,
        "RobotConfig.getTcpForceSensorNames": lambda _: [],
        "RobotConfig.hasBaseForceSensor": lambda _: False,
        "RobotConfig.getBaseForceSensorNames": lambda _: [],
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
        "RobotManage.getRobotControlMode": lambda _: control_mode(cabinet),
        # No arm is behind this controller.
        "RobotManage.isSimulationEnabled": lambda _: True,
        "RobotManage.isFreedriveEnabled": lambda _: False,
        "RobotManage.isBackdriveEnabled": lambda _: False,
        "RobotManage.isLinkModeEnabled": lambda _: False,
        "ForceControl.isFcEnabled": lambda _: False,
        "ForceControl.fcDisable": lambda _: ReturnCode.OK,
        "Trace.peek": lambda p: _peek(cabinet, int(p["num"]), int(p.get("last_time", 0))),
        "Trace.textmsg": lambda _: ReturnCode.OK,
    }


def _of_the_state(cabinet: Cabinet) -> Table:
    power, motion, now_s = cabinet.power, cabinet.motion, cabinet.now_s
    return {
        "RobotState.getRobotModeType": lambda _: power.mode.value,
        "RobotState.getSafetyModeType": lambda _: power.safety.value,
        "RobotState.isPowerOn": lambda _: power.on,
        "RobotState.isCollisionOccurred": lambda _: power.collision,
        "RobotState.isWithinSafetyLimits": lambda _: power.safety in MOVING_ALLOWED,
        "RobotState.isSteady": lambda _: motion.steady(now_s()),
        "RobotState.getTcpPose": lambda _: to_wire(cabinet.tcp()),
        "RobotState.getToolPose": lambda _: to_wire(cabinet.flange()),
        "RobotState.getActualTcpOffset": lambda _: cabinet.tcp_offset,
        "RobotState.getJointPositions": lambda _: cabinet.joints(),
        "RobotState.getJointTargetPositions": lambda _: cabinet.joints(),
        "RobotState.getJointState": lambda _: [joint_state(power.mode)] * 6,
        "RobotState.getTcpTargetPose": lambda _: to_wire(cabinet.tcp()),
        "RobotState.getTargetTcpPose": lambda _: to_wire(cabinet.configured(motion.ends(now_s()))),
        "RobotState.getTcpSpeed": lambda _: cabinet.tcp_speed(),
        "RobotState.getJointSpeeds": lambda _: motion.joint_velocity(now_s()),
        "RobotState.getTcpForce": lambda _: cabinet.force(),
        "RobotAlgorithm.forwardKinematics": lambda p: cabinet.fk(p["q"], tip=True),
        "RobotAlgorithm.forwardToolKinematics": lambda p: cabinet.fk(p["q"], tip=False),
        "RobotAlgorithm.inverseKinematics": lambda p: cabinet.ik(_floats(p["qnear"], 6), p["pose"]),
        "RobotAlgorithm.inverseToolKinematics": lambda p: cabinet.ik(_floats(p["qnear"], 6), p["pose"], tip=False),
    }


def runtime_state(cabinet: Cabinet) -> str:
    """Motion from a client runs with the runtime Stopped."""
    return "Paused" if cabinet.motion.held else "Stopped"


def control_mode(cabinet: Cabinet) -> str:
    """How the arm is controlled, in the maker's words."""
    if cabinet.servo_mode:
        return "Servo"
    return "Speed" if cabinet.motion.drifting(cabinet.now_s()) else "Position"


def joint_state(mode: RobotMode) -> str:
    """What every joint says of itself in a robot mode."""
    if mode in {RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BRAKE_RELEASING}:
        return "Idle"
    return "Running" if mode == RobotMode.RUNNING else "Poweroff"


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
