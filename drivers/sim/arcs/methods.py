"""The methods of the loopback controller by their names on the wire; any other method is unknown to it (-32601).

A pose out of reach is accepted first and fails in planning, as on a controller. Speeds above what the arm allows are
clipped. The joints' speeds are those of the maker's URDF for the i5; the other maxima are the examples in the SDK's
headers, which are for an i5H. A real cabinet reports its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import from_wire, to_wire
from brushloop.drivers.sim.arcs.cabinet import ROBOT, SOFT_STOP_M_S2, Cabinet
from brushloop.drivers.sim.kinematics import LIMITS_DEG, Joints, inverse, inverted, matrix_of

Params = dict[str, Any]

JOINT_SPEEDS_RAD_S = (2.5964, 2.5964, 2.5964, 3.1105, 3.1105, 3.1105)
JOINT_ACCS_RAD_S2 = (31.1, 31.1, 31.1, 20.7, 20.7, 20.7)
TCP_SPEED_M_S, TCP_TURN_RAD_S = 2.0, 5.0
TCP_ACC_M_S2, TCP_TURN_RAD_S2 = 10.0, 10.0
REDUCED_M_S = 0.25
"""Limit in reduced mode and manual operation: ISO 10218-1's reduced speed, 250 mm/s. Configurable on a real cabinet."""
REACH_M = 0.8865
REDUCED_RAD_S = REDUCED_M_S / REACH_M
"""Joint speed at which the tip of the stretched arm stays below `REDUCED_M_S`."""
POSE_OUT_OF_REACH = 30047
BLEND_M = (0.001, 1.0)


class Moves:
    """The queue of one cabinet, and its limits."""

    def __init__(self, cabinet: Cabinet) -> None:
        self._cabinet = cabinet
        self._near = cabinet.motion.near
        """Joints of the last pose that was asked for: the next one is likely to be near."""

    def methods(self) -> dict[str, Callable[[Params], Any]]:
        """The methods by `Class.method`, without the robot's name."""
        cabinet, motion = self._cabinet, self._cabinet.motion
        return {
            "MotionControl.moveLine": self._line,
            "MotionControl.moveJoint": self._joint,
            "MotionControl.stopLine": lambda p: cabinet.stop(float(p["acc"]), float(p["acc_rot"])),
            "MotionControl.stopJoint": lambda p: cabinet.stop(SOFT_STOP_M_S2, float(p["acc"])),
            "MotionControl.stopMove": lambda _: cabinet.hold(),
            "MotionControl.startMove": lambda _: cabinet.resume(),
            "MotionControl.setSpeedFraction": lambda p: cabinet.set_speed_fraction(float(p["fraction"])),
            "MotionControl.getSpeedFraction": lambda _: motion.fraction,
            "MotionControl.getExecId": lambda _: motion.exec_id(cabinet.now_s()),
            "MotionControl.getQueueSize": lambda _: self._queue_size(),
        }

    def _line(self, p: Params) -> int:
        target = from_wire([float(v) for v in p["pose"]])
        if (code := self._admit(p)) != ReturnCode.OK:
            return code
        if not self._reachable(target):
            return self._out_of_reach()
        cabinet = self._cabinet
        speed_m_s, acc_m_s2 = self._pace(p, TCP_SPEED_M_S, TCP_ACC_M_S2, REDUCED_M_S)
        added = cabinet.motion.add(
            target,
            speed_m_s * 1e3,
            acc_m_s2 * 1e3,
            cabinet.now_s(),
            float(p.get("duration", 0.0)),
            blend_mm=float(p.get("blend_radius", 0.0)) * 1e3,
            fix=cabinet.fix,
        )
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def _joint(self, p: Params) -> int:
        q = [float(v) for v in p["q"]]
        if len(q) != 6 or not all(math.isfinite(v) for v in q):
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self._admit(p)) != ReturnCode.OK:
            return code
        if any(abs(v) > math.radians(limit) for v, limit in zip(q, LIMITS_DEG, strict=True)):
            return self._out_of_reach()
        speed_rad_s, acc_rad_s2 = self._pace(p, min(JOINT_SPEEDS_RAD_S), min(JOINT_ACCS_RAD_S2), REDUCED_RAD_S)
        joints: Joints = (q[0], q[1], q[2], q[3], q[4], q[5])
        least_s = float(p.get("duration", 0.0))
        added = self._cabinet.motion.add_joints(joints, speed_rad_s, acc_rad_s2, self._cabinet.now_s(), least_s)
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def _admit(self, p: Params) -> int:
        """Return code for queueing a move: OK if it may be queued."""
        if self._cabinet.power.mode != RobotMode.RUNNING:
            return -1
        if self._cabinet.power.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        acc, speed, duration_s = float(p["a"]), float(p["v"]), float(p.get("duration", 0.0))
        blend_m = float(p.get("blend_radius", 0.0))
        timed = math.isfinite(duration_s) and duration_s > 0.0  # then a and v may be left at 0
        if not (duration_s == 0.0 or timed) or math.isnan(acc) or math.isnan(speed):
            return -ReturnCode.INVALID_ARGUMENT
        if not (timed or (acc > 0.0 and speed > 0.0)) or not (blend_m == 0.0 or BLEND_M[0] <= blend_m <= BLEND_M[1]):
            return -ReturnCode.INVALID_ARGUMENT
        return ReturnCode.QUEUE_FULL if self._cabinet.motion.full else ReturnCode.OK

    def _pace(self, p: Params, fastest: float, hardest: float, reduced: float) -> tuple[float, float]:
        """Speed and acceleration, clipped to what the arm allows; the maxima if only a duration was given."""
        speed, acc = float(p["v"]), float(p["a"])
        slow = self._cabinet.power.safety == SafetyMode.REDUCED or self._cabinet.operational_mode == "Manual"
        limit = reduced if slow else fastest
        return min(speed, limit) if speed > 0.0 else limit, min(acc, hardest) if acc > 0.0 else hardest

    def _reachable(self, target: Pose) -> bool:
        """Whether the arm can reach a pose of the configured tool centre point."""
        flange = matrix_of(target) @ inverted(self._cabinet.tool())
        joints = inverse(flange, self._near) or inverse(flange, self._cabinet.motion.near)
        self._near = joints or self._near
        return joints is not None

    def _out_of_reach(self) -> int:
        """Accept a move that then proves to be out of reach: the arm stops and a message says why."""
        self._cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
        self._cabinet.tell(POSE_OUT_OF_REACH)
        return ReturnCode.OK

    def _queue_size(self) -> int:
        self._cabinet.motion.advance(self._cabinet.now_s())
        return self._cabinet.motion.size


INTERFACE_VERSION = 24000
CONTROL_SOFTWARE_VERSION = 31001
SOFTWARE_VERSION = f"0.31.1-{LOOPBACK_CONTROL_BOX}"
OPERATIONAL_MODES = ("Disabled", "Automatic", "Manual")

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
