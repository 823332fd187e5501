"""The loopback cabinet: an arm's motion, tool, power and safety, and its methods by their names on the wire.

It simulates what a driver can get wrong: refusals by return code, poses that are accepted first and fail in planning, a
path that a protective stop keeps. It simulates neither accuracy nor safety functions, nor the arm's highest speeds.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.arcs.wire import numbers
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import from_wire, to_wire
from brushloop.drivers.sim.kinematics import Joints, Matrix, forward, inverse, matrix_of, pose_of
from brushloop.drivers.sim.world import World

BOOT_S = 0.7
POWER_ON_S = 1.0
"""Time from `poweron` to Idle."""
BRAKE_RELEASE_S = 1.0
POWER_OFF_S = 0.3


class Power:
    """Power and safety state. `now_s` is simulated time; each transition takes effect when it is due."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._steps: list[tuple[float, RobotMode]] = [(-1.0, RobotMode.POWER_OFF)]
        self.safety = SafetyMode.NORMAL

    @property
    def mode(self) -> RobotMode:
        """The robot mode now."""
        while len(self._steps) > 1 and self._steps[1][0] <= self._now_s():
            self._steps.pop(0)
        return self._steps[0][1]

    @property
    def joint_state(self) -> str:
        """What every joint reports in the robot mode."""
        if self.mode in {RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BRAKE_RELEASING}:
            return "Idle"
        return "Running" if self.mode == RobotMode.RUNNING else "Poweroff"

    def power_on(self) -> int:
        """Request power; Idle comes `POWER_ON_S` later."""
        if self.safety == SafetyMode.ROBOT_EMERGENCY_STOP:
            return ReturnCode.BAD_STATE
        if self.mode == RobotMode.POWER_OFF:
            self.then((0.0, RobotMode.BOOTING), (BOOT_S, RobotMode.POWER_ON), (POWER_ON_S, RobotMode.IDLE))
        return ReturnCode.OK

    def start_up(self) -> int:
        """Request the brakes' release; Running comes `BRAKE_RELEASE_S` later."""
        if self.mode == RobotMode.RUNNING:
            return ReturnCode.OK
        if self.mode != RobotMode.IDLE or self.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        self.then((0.0, RobotMode.BRAKE_RELEASING), (BRAKE_RELEASE_S, RobotMode.RUNNING))
        return ReturnCode.OK

    def then(self, *steps: tuple[float, RobotMode]) -> None:
        """Go through these modes, each so many seconds from now."""
        now_s = self._now_s()
        self._steps = [(now_s + after_s, mode) for after_s, mode in steps]


ROBOT = "rob1"
IK_NO_CONVERGE = -23
POSE_OUT_OF_REACH = 30047
HARD_STOP_M_S2 = 10.0
SOFT_STOP_M_S2 = 2.0
BLEND_M = (0.001, 1.0)
MOST_MOVES = 64

Params = dict[str, Any]


class Cabinet:
    """State behind the controller's methods. The world decides where the tip is; the joints follow from it."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.motion = world.motion
        self.power = Power(self.now_s)
        self.tcp_offset = [0.0] * 6
        """Flange to tool centre point as configured: x, y, z in m and three angles in rad. The true tip stays."""
        self.payload: list[Any] = [0.0, [0.0] * 3, [0.0] * 3, [0.0] * 6]
        """Mass in kg, centre of gravity in m, and what a robot has beside."""
        self.collision_level = 6
        self.speed_fraction = 1.0
        self.operational_mode = "Automatic"
        self.messages: list[dict[str, Any]] = []

    def now_s(self) -> float:
        """Simulated time."""
        return self.world.clock.now_s()

    def safety_stop(self, mode: SafetyMode = SafetyMode.PROTECTIVE_STOP) -> None:
        """Enter a safety stop where the arm is; only a person can clear it, and no lesser stop replaces it.

        A protective stop keeps the path. An emergency stop switches the power off at once.
        """
        if mode == SafetyMode.PROTECTIVE_STOP:
            self.hold(HARD_STOP_M_S2)
        else:
            self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)
        if mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            self.power.then((0.0, RobotMode.POWER_OFF))
        elif self.power.safety == SafetyMode.ROBOT_EMERGENCY_STOP:
            return
        self.power.safety = mode

    def release(self) -> str:
        """End a safety stop as a person at the arm would; return the previous safety mode.

        After an emergency stop the arm stays without power.
        """
        before, self.power.safety = self.power.safety, SafetyMode.NORMAL
        return before.value

    def power_off(self) -> int:
        """Stop the arm, engage the brakes, then switch its power off."""
        self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)
        self.power.then((0.0, RobotMode.POWERING_OFF), (POWER_OFF_S, RobotMode.POWER_OFF))
        return ReturnCode.OK

    @property
    def _tool(self) -> Matrix:
        """From the flange to the configured tool centre point."""
        return matrix_of(from_wire(self.tcp_offset))

    @property
    def _fix(self) -> Matrix | None:
        """From the configured tool centre point to the true tip; None if they are the same."""
        fix = np.linalg.inv(self._tool) @ self.motion.tool
        return None if np.abs(fix - np.eye(4)).max() < 1e-9 else fix

    def configured(self, tip: Pose) -> Pose:
        """Where the controller takes the tip to be, at the configured tool centre point, when the true one is there."""
        fix = self._fix
        return tip if fix is None else pose_of(matrix_of(tip) @ np.linalg.inv(fix))

    def fk(self, p: Params) -> list[Any]:
        """[pose of the configured tool centre point, return code]."""
        return [to_wire(pose_of(forward(numbers("forwardKinematics", p["q"])) @ self._tool)), 0]

    def ik(self, p: Params) -> list[Any]:
        """[joints, return code]; the joints are `qnear` if there is no solution."""
        target, near = (numbers("inverseKinematics", p[name]) for name in ("pose", "qnear"))
        joints = self._solved(from_wire(target), near)
        return [near, IK_NO_CONVERGE] if joints is None else [joints, 0]

    def _solved(self, target: Pose, near: Sequence[float]) -> Joints | None:
        """Joints for a pose of the configured tool centre point, searched from `near`."""
        return inverse(matrix_of(target) @ np.linalg.inv(self._tool), near)

    def stop(self, acc_m_s2: float, acc_rad_s2: float) -> int:
        """Decelerate and forget the path."""
        self.motion.stop(acc_m_s2 * 1e3, acc_rad_s2, self.now_s())
        return ReturnCode.OK

    def hold(self, acc_m_s2: float = SOFT_STOP_M_S2) -> int:
        """Decelerate and keep the path."""
        self.motion.hold(acc_m_s2 * 1e3, acc_m_s2, self.now_s())
        return ReturnCode.OK

    def resume(self) -> int:
        """Resume a path that was held. Refused while a safety stop lasts."""
        code = self._may_move()
        if code == ReturnCode.OK:
            self.motion.resume(self.now_s())
        return code

    def _may_move(self) -> int:
        if self.power.mode != RobotMode.RUNNING:
            return -1
        return ReturnCode.OK if self.power.safety in MOVING_ALLOWED else ReturnCode.BAD_STATE

    def move_line(self, p: Params) -> int:
        """Queue a line; a pose out of reach is accepted first and fails in planning, as on a controller."""
        target = from_wire(numbers("moveLine", p["pose"]))
        if (code := self._may_move()) != ReturnCode.OK:
            return code
        speed_m_s, acc_m_s2 = p["v"], p["a"]
        duration_s, blend_m = p.get("duration", 0.0), p.get("blend_radius", 0.0)
        paced = acc_m_s2 > 0.0 and speed_m_s > 0.0 and 0.0 <= duration_s < math.inf
        if not paced or not (blend_m == 0.0 or BLEND_M[0] <= blend_m <= BLEND_M[1]):
            return -ReturnCode.INVALID_ARGUMENT
        if self.motion.size(self.now_s()) >= MOST_MOVES:
            return ReturnCode.QUEUE_FULL
        if self._solved(target, self.motion.near) is None:
            # It is accepted, then proves to be out of reach: the arm stops, and a message for `Trace.peek` says why.
            self.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
            stamp = max(int(self.now_s() * 1e9), self.messages[-1]["timestamp"] + 1 if self.messages else 1)
            self.messages.append(
                {"code": POSE_OUT_OF_REACH, "level": "ERROR", "source": ROBOT, "args": [], "timestamp": stamp}
            )
            return ReturnCode.OK
        pace = speed_m_s * 1e3, acc_m_s2 * 1e3
        added = self.motion.add(target, *pace, self.now_s(), duration_s, blend_mm=blend_m * 1e3, fix=self._fix)
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def configure(self, name: str, value: object) -> int:
        """Set one of the cabinet's settings."""
        setattr(self, name, value)
        return ReturnCode.OK

    def peek(self, count: int, after: int) -> list[dict[str, Any]]:
        """The newest `count` messages after a time stamp."""
        return [m for m in self.messages if m["timestamp"] > after][-count:] if count > 0 else []


def methods(cabinet: Cabinet) -> dict[str, Callable[[Params], Any]]:
    """Every method that the controller knows by name, from named params to what goes on the wire.

    Any other method is unknown to it (-32601). May raise KeyError, TypeError or ValueError for wrong params.
    """
    power, motion, now_s = cabinet.power, cabinet.motion, cabinet.now_s
    of_robot: dict[str, Callable[[Params], Any]] = {
        "MotionControl.moveLine": cabinet.move_line,
        # A line to the same place: no driver here moves in joints.
        "MotionControl.moveJoint": lambda p: cabinet.move_line({**p, "pose": cabinet.fk(p)[0]}),
        "MotionControl.stopLine": lambda p: cabinet.stop(p["acc"], p["acc_rot"]),
        "MotionControl.stopMove": lambda _: cabinet.hold(),
        "MotionControl.startMove": lambda _: cabinet.resume(),
        "MotionControl.setSpeedFraction": lambda p: cabinet.configure("speed_fraction", p["fraction"]),
        "MotionControl.getSpeedFraction": lambda _: cabinet.speed_fraction,
        "MotionControl.getExecId": lambda _: motion.exec_id(now_s()),
        "MotionControl.getQueueSize": lambda _: motion.size(now_s()),
        "RobotConfig.getRobotType": lambda _: "aubo_i5",
        "RobotConfig.getRobotSubType": lambda _: "aubo_i5_11",
        "RobotConfig.getControlBoxType": lambda _: LOOPBACK_CONTROL_BOX,
        "RobotConfig.getDof": lambda _: 6,
        "RobotConfig.setTcpOffset": lambda p: cabinet.configure("tcp_offset", numbers("setTcpOffset", p["offset"])),
        "RobotConfig.getTcpOffset": lambda _: cabinet.tcp_offset,
        "RobotConfig.setPayload": lambda p: cabinet.configure("payload", [p["m"], p["cog"], p["aom"], p["inertia"]]),
        "RobotConfig.getPayload": lambda _: cabinet.payload,
        "RobotConfig.setCollisionLevel": lambda p: cabinet.configure("collision_level", p["level"]),
        "RobotConfig.getCollisionLevel": lambda _: cabinet.collision_level,
        "RobotManage.poweron": lambda _: power.power_on(),
        "RobotManage.startup": lambda _: power.start_up(),
        "RobotManage.poweroff": lambda _: cabinet.power_off(),
        "RobotManage.getOperationalMode": lambda _: cabinet.operational_mode,
        "RobotManage.setOperationalMode": lambda p: cabinet.configure("operational_mode", p["mode"]),
        "RobotManage.isSimulationEnabled": lambda _: True,  # no arm is behind this controller
        "RobotState.getRobotModeType": lambda _: power.mode.value,
        "RobotState.getSafetyModeType": lambda _: power.safety.value,
        "RobotState.isPowerOn": lambda _: power.joint_state != "Poweroff",
        "RobotState.isSteady": lambda _: motion.steady(now_s()),
        "RobotState.getTcpPose": lambda _: to_wire(cabinet.configured(cabinet.world.tool())),
        "RobotState.getJointPositions": lambda _: motion.near_joints(cabinet.world.tool()),
        "RobotState.getJointState": lambda _: [power.joint_state] * 6,
        "RobotAlgorithm.forwardKinematics": cabinet.fk,
        "RobotAlgorithm.inverseKinematics": cabinet.ik,
        "Trace.peek": lambda p: cabinet.peek(p["num"], p["last_time"]),
    }
    of_controller: dict[str, Callable[[Params], Any]] = {
        "SystemInfo.getInterfaceVersionCode": lambda _: 24000,
        "SystemInfo.getControlSoftwareVersionCode": lambda _: 31001,
        "SystemInfo.getControlSoftwareFullVersion": lambda _: f"0.31.1-{LOOPBACK_CONTROL_BOX}",
        "getRobotNames": lambda _: [ROBOT],
        "RuntimeMachine.abort": lambda _: cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2),
        "RuntimeMachine.pause": lambda _: cabinet.hold(),
        "RuntimeMachine.resume": lambda _: cabinet.resume(),
        # Motion from a client runs with the runtime Stopped.
        "RuntimeMachine.getRuntimeState": lambda _: "Paused" if motion.held else "Stopped",
    }
    return {f"{ROBOT}.{name}": method for name, method in of_robot.items()} | of_controller
