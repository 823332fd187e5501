"""A whole session of the maker's own client; runs alone, since that client holds the GIL while it waits.

Usage: python -m tests.vendor.session PORT RTDE_PORT.
The last line of the output is one JSON object: what every step returned.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable
from typing import Any

import pyaubo_sdk as sdk  # pyright: ignore[reportMissingImports]

from tests.waiting import wait_until

SEEN: dict[str, Any] = {}


def failure(call: Callable[[], object]) -> str:
    """What the client raises, up to the code of the error."""
    try:
        return f"no exception: {call()!r}"
    except sdk.AuboException as error:
        method, code, _ = re.split(r"(--\d+)", str(error), maxsplit=1)
        return f"AuboException: {method}{code}"


def at_rest(robot: Any) -> bool:
    return robot.getMotionControl().getExecId() == -1 and robot.getRobotState().isSteady()


def shifted(pose: list[float], x_m: float) -> list[float]:
    return [pose[0] + x_m, *pose[1:]]


def identify(rpc: Any, robot: Any) -> None:
    config = robot.getRobotConfig()
    info = rpc.getSystemInfo()
    SEEN["versions"] = [info.getInterfaceVersionCode(), info.getControlSoftwareVersionCode()]
    SEEN["version"] = info.getControlSoftwareFullVersion()
    SEEN["types"] = [config.getRobotType(), config.getRobotSubType(), config.getControlBoxType(), config.getDof()]


def set_up(robot: Any) -> None:
    config, manage = robot.getRobotConfig(), robot.getRobotManage()
    SEEN["tcp"] = [config.setTcpOffset([0.0, 0.0, 0.18, 0.0, 0.0, 0.0]), config.getTcpOffset()]
    payload = config.setPayload(0.5, [0.0, 0.0, 0.05], [0.0] * 3, [0.0] * 6)
    SEEN["payload"] = [payload, config.getPayload()]
    SEEN["collision"] = [config.setCollisionLevel(7), config.getCollisionLevel()]
    SEEN["operational"] = []
    for mode in (sdk.OperationalModeType.Manual, sdk.OperationalModeType.Automatic):
        manage.setOperationalMode(mode)
        SEEN["operational"].append(manage.getOperationalMode() == mode)


def power(robot: Any) -> None:
    manage, state = robot.getRobotManage(), robot.getRobotState()
    SEEN["mode before"] = str(state.getRobotModeType())
    SEEN["refused"] = robot.getMotionControl().moveLine(state.getTcpPose(), 1.0, 0.1, 0.0, 0.0)
    manage.poweron()
    wait_until(lambda: state.getRobotModeType() == sdk.RobotModeType.Idle, "power")
    manage.startup()
    wait_until(lambda: state.getRobotModeType() == sdk.RobotModeType.Running, "the brakes to open")
    SEEN["safety"] = str(state.getSafetyModeType())
    SEEN["power on"] = state.isPowerOn()
    SEEN["joint state"] = [str(s) for s in state.getJointState()]
    SEEN["simulated"] = manage.isSimulationEnabled()


def move(rpc: Any, robot: Any) -> None:
    motion, state, machine = robot.getMotionControl(), robot.getRobotState(), rpc.getRuntimeMachine()
    start = state.getTcpPose()
    SEEN["move"] = [motion.moveLine(shifted(start, 0.05), 1.0, 0.1, 0.0, 0.0), motion.getExecId() >= 0]
    SEEN["queue"] = motion.getQueueSize()
    wait_until(lambda: at_rest(robot), "the move to end")
    SEEN["moved by"] = state.getTcpPose()[0] - start[0]
    SEEN["same"] = motion.moveLine(state.getTcpPose(), 1.0, 0.1, 0.0, 0.0)
    for way, stop in (("stopLine", lambda: motion.stopLine(2.0, 2.0)), ("abort", machine.abort)):
        before = state.getTcpPose()
        motion.moveLine(shifted(before, -0.04), 1.0, 0.01, 0.0, 0.0)
        time.sleep(0.05)
        stopped = stop()
        wait_until(lambda: at_rest(robot), f"rest after {way}", timeout_s=1.0)
        SEEN[way] = [stopped, before[0] - state.getTcpPose()[0]]
    motion.moveLine(start, 1.0, 0.05, 0.0, 0.0)
    SEEN["pause"] = [machine.pause(), str(machine.getRuntimeState()), motion.getExecId() >= 0]
    SEEN["resume"] = [machine.resume(), str(machine.getRuntimeState())]
    wait_until(lambda: at_rest(robot), "the path to end")
    SEEN["fraction"] = [motion.setSpeedFraction(0.5), motion.getSpeedFraction(), motion.setSpeedFraction(1.0)]


def joints(robot: Any) -> None:
    motion, state, algorithm = robot.getMotionControl(), robot.getRobotState(), robot.getRobotAlgorithm()
    q = state.getJointPositions()
    pose, fk = algorithm.forwardKinematics(q)
    back, ik = algorithm.inverseKinematics([v + 0.02 for v in q], pose)
    SEEN["fk"] = [fk, max(abs(a - b) for a, b in zip(pose[:3], state.getTcpPose()[:3], strict=True))]
    SEEN["ik"] = [ik, max(abs(a - b) for a, b in zip(back, q, strict=True))]
    SEEN["ik far"] = algorithm.inverseKinematics(q, [2.0, 0.0, 0.2, 3.14, 0.0, 0.0])[1]
    target = [v + 0.05 for v in q]
    SEEN["joint move"] = motion.moveJoint(target, 2.0, 1.0, 0.0, 0.0)
    wait_until(lambda: at_rest(robot), "the joints to arrive")
    SEEN["joints off"] = max(abs(a - b) for a, b in zip(target, state.getJointPositions(), strict=True))


def blend(robot: Any) -> None:
    """Four moves, sent while the path is held, as a client does that must not be slower than the arm."""
    motion, state = robot.getMotionControl(), robot.getRobotState()
    start = state.getTcpPose()
    corner, end = shifted(start, 0.04), [start[0] + 0.04, start[1] + 0.04, *start[2:]]
    motion.stopMove(True, True)
    SEEN["blend sent"] = [motion.moveLine(pose, 1.0, 0.02, 0.015, 0.0) for pose in (corner, end)]
    SEEN["blend start"] = motion.startMove()
    nearest, ids = 1.0, set()
    while not at_rest(robot):
        pose = state.getTcpPose()
        nearest = min(nearest, sum((a - b) ** 2 for a, b in zip(pose[:3], corner[:3], strict=True)) ** 0.5)
        ids.add(motion.getExecId())
    off = max(abs(a - b) for a, b in zip(end, state.getTcpPose(), strict=True))
    SEEN["blend"] = [nearest, len(ids - {-1}), off]


def subscribe(port: int) -> None:
    rtde = sdk.RtdeClient()
    pushed: list[tuple[list[float], list[float], bool, bool]] = []

    def take(parser: Any) -> None:
        q, pose = parser.popVectorDouble(), parser.popVectorDouble()
        running = parser.popRobotModeType() == sdk.RobotModeType.Running
        pushed.append((q, pose, running, parser.popSafetyModeType() == sdk.SafetyModeType.Normal))

    SEEN["rtde connect"] = [rtde.connect("127.0.0.1", port), rtde.login("aubo", "123456")]
    SEEN["rtde pose"] = rtde.getOutputMaps()["R1_actual_TCP_pose"]
    names = ["R1_actual_q", "R1_actual_TCP_pose", "R1_robot_mode", "R1_safety_mode"]
    channel = -1
    for _ in range(5):  # right after login the client may not be ready to send
        time.sleep(0.2)
        channel = rtde.setTopic(False, names, 50.0, 0)
        if channel >= 0:
            break
    SEEN["rtde topic"] = [channel, rtde.subscribe(channel, take)]
    wait_until(lambda: len(pushed) >= 10, "ten samples")
    q, pose, running, normal = pushed[9]
    SEEN["rtde pushed"] = [len(q), len(pose), running, normal]
    SEEN["rtde removed"] = rtde.removeTopic(False, channel)
    time.sleep(3.5)  # after three seconds of silence it pings
    SEEN["rtde connected"] = rtde.hasConnected()
    rtde.disconnect()


def go_wrong(robot: Any) -> None:
    motion = robot.getMotionControl()
    SEEN["unknown method"] = failure(motion.getEqradius)
    SEEN["wrong call"] = failure(lambda: robot.getRobotAlgorithm().forwardKinematics([1.0]))
    SEEN["out of reach"] = motion.moveLine([2.0, 0.0, 0.2, 3.14, 0.0, 0.0], 1.0, 0.1, 0.0, 0.0)
    SEEN["messages"] = [[m.code, str(m.level), m.source] for m in robot.getTrace().peek(5, 0)]


def main(port: int, rtde_port: int) -> None:
    rpc = sdk.RpcClient()
    rpc.setRequestTimeout(60_000)  # ms: a busy machine takes its time
    SEEN["connect"] = rpc.connect("127.0.0.1", port)
    SEEN["login"] = [rpc.login("aubo", "123456"), rpc.hasLogined()]
    SEEN["names"] = rpc.getRobotNames()
    robot = rpc.getRobotInterface(rpc.getRobotNames()[0])
    identify(rpc, robot)
    set_up(robot)
    power(robot)
    move(rpc, robot)
    joints(robot)
    blend(robot)
    subscribe(rtde_port)
    go_wrong(robot)
    SEEN["power off"] = robot.getRobotManage().poweroff()
    rpc.logout()
    rpc.disconnect()
    SEEN["connected at the end"] = rpc.hasConnected()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
    sys.stdout.write("\n" + json.dumps(SEEN) + "\n")
