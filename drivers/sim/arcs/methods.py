"""The methods of the loopback controller by their names on the wire; any other method is unknown to it (-32601)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from brushloop.drivers.arcs.codes import LOOPBACK_CONTROL_BOX, ReturnCode, RobotMode
from brushloop.drivers.geometry import to_wire
from brushloop.drivers.sim.arcs.cabinet import ROBOT, SOFT_STOP_M_S2, Cabinet
from brushloop.drivers.sim.arcs.moves import Moves

INTERFACE_VERSION = 24000
CONTROL_SOFTWARE_VERSION = 31001
SOFTWARE_VERSION = f"0.31.1-{LOOPBACK_CONTROL_BOX}"
OPERATIONAL_MODES = ("Disabled", "Automatic", "Manual")

Params = dict[str, Any]
Table = dict[str, Callable[[Params], Any]]


def methods(cabinet: Cabinet) -> Table:
    """Every method that the controller knows; each takes named params and returns what goes on the wire."""
    of_robot = _of_the_robot(cabinet) | _of_the_state(cabinet) | Moves(cabinet).methods()
    return {f"{ROBOT}.{name}": method for name, method in of_robot.items()} | _of_the_controller(cabinet)


def _of_the_controller(cabinet: Cabinet) -> Table:
    return {
        "SystemInfo.getInterfaceVersionCode": lambda _: INTERFACE_VERSION,
        "SystemInfo.getControlSoftwareVersionCode": lambda _: CONTROL_SOFTWARE_VERSION,
        "SystemInfo.getControlSoftwareFullVersion": lambda _: SOFTWARE_VERSION,
        "getRobotNames": lambda _: [ROBOT],
        "RuntimeMachine.abort": lambda _: cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2),
        # Stops a program, not motion that clients asked for.
        "RuntimeMachine.stop": lambda _: ReturnCode.OK,
        "RuntimeMachine.pause": lambda _: cabinet.hold(),
        "RuntimeMachine.resume": lambda _: cabinet.resume(),
        # Motion from a client runs with the runtime Stopped.
        "RuntimeMachine.getRuntimeState": lambda _: "Paused" if cabinet.motion.held else "Stopped",
        "RegisterControl.setWatchDog": lambda p: cabinet.set_watchdog(
            str(p["key"]), float(p["timeout"]), int(p["action"])
        ),
    }


def _of_the_robot(cabinet: Cabinet) -> Table:
    power = cabinet.power
    return {
        "RobotConfig.getRobotType": lambda _: "aubo_i5",
        "RobotConfig.getRobotSubType": lambda _: "aubo_i5_11",
        "RobotConfig.getControlBoxType": lambda _: LOOPBACK_CONTROL_BOX,
        "RobotConfig.getDof": lambda _: 6,
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
        # No arm is behind this controller.
        "RobotManage.isSimulationEnabled": lambda _: True,
        "Trace.peek": lambda p: _peek(cabinet, int(p["num"]), int(p.get("last_time", 0))),
    }


def _of_the_state(cabinet: Cabinet) -> Table:
    power, motion, now_s = cabinet.power, cabinet.motion, cabinet.now_s
    return {
        "RobotState.getRobotModeType": lambda _: power.mode.value,
        "RobotState.getSafetyModeType": lambda _: power.safety.value,
        "RobotState.isPowerOn": lambda _: power.on,
        "RobotState.isSteady": lambda _: motion.steady(now_s()),
        "RobotState.getTcpPose": lambda _: to_wire(cabinet.tcp()),
        "RobotState.getJointPositions": lambda _: cabinet.joints(),
        "RobotState.getJointState": lambda _: [_joint_state(power.mode)] * 6,
        "RobotAlgorithm.forwardKinematics": lambda p: cabinet.fk(p["q"]),
        "RobotAlgorithm.inverseKinematics": lambda p: cabinet.ik(_floats(p["qnear"], 6), p["pose"]),
    }


def _joint_state(mode: RobotMode) -> str:
    """What every joint reports in a robot mode."""
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
