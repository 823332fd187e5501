"""A transcript of questions that change nothing: what a cabinet answered, word for word, for a report of a defect."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

from brushloop.drivers.arcs.telemetry import JOINTS_SEGMENT, POSE_SEGMENT, RtdeStream
from brushloop.drivers.arcs.wire import Framing, RpcConnection, open_arcs
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, RpcError

OF_THE_CONTROLLER = (
    "SystemInfo.getControlSoftwareVersionCode",
    "SystemInfo.getControlSoftwareFullVersion",
    "RuntimeMachine.getRuntimeState",
)
OF_THE_ROBOT = (
    *("RobotConfig.getRobotType", "RobotConfig.getRobotSubType", "RobotConfig.getControlBoxType", "RobotConfig.getDof"),
    *("RobotConfig.getTcpOffset", "RobotConfig.getPayload", "RobotConfig.getCollisionLevel"),
    *("RobotManage.getOperationalMode", "RobotManage.isSimulationEnabled", "MotionControl.getSpeedFraction"),
    *("MotionControl.getExecId", "MotionControl.getQueueSize", "RobotState.getRobotModeType"),
    *("RobotState.getSafetyModeType", "RobotState.isPowerOn", "RobotState.isSteady", "RobotState.getJointState"),
    *("RobotState.getTcpPose", "RobotState.getJointPositions"),
)
"""Asked without parameters; then kinematics are asked where the arm is, and for the newest messages."""
MESSAGES = 5


@dataclass(frozen=True, slots=True)
class Exchange:
    """One question and what came back."""

    method: str
    params: dict[str, Any] | None
    answer: dict[str, Any]
    """`result` or `error` as the controller sent it, else `silence`, `lost` or `refused`: why there is none."""
    took_ms: float


async def survey(host: str, port: int, framing: Framing) -> list[Exchange]:
    """Ask everything on one connection. An answer that is missing or senseless is noted, and the next one asked.

    Ends early where the controller does not connect or hangs up. Sets, powers and moves nothing.
    """
    connection = RpcConnection(host, port, framing=framing)
    try:
        return [exchange async for exchange in _asked(connection)]
    finally:
        await connection.close()


async def _asked(connection: RpcConnection) -> AsyncIterator[Exchange]:
    """Ask in the driver's order: version before login, then names of the robots, then everything about the first."""
    try:
        await open_arcs(connection)
    except DeviceError as error:
        yield Exchange("connect", None, {"refused": str(error)}, 0.0)
        return
    answers: dict[str, Any] = {}

    async def ask(method: str, params: dict[str, Any] | None = None) -> Exchange:
        exchange = await _exchange(connection, method, params)
        answers[method.rpartition(".")[2]] = exchange.answer.get("result")
        return exchange

    yield await ask("SystemInfo.getInterfaceVersionCode")
    try:
        await connection.login()
    except DeviceError as error:
        yield Exchange("login", None, {"refused": str(error)}, 0.0)
        if connection.lost:
            return
    yield await ask("getRobotNames")
    names = answers["getRobotNames"]
    robot = str(names[0]) if isinstance(names, list) and names else "rob1"  # pyright: ignore[reportUnknownArgumentType]
    for method in (*OF_THE_CONTROLLER, *(f"{robot}.{name}" for name in OF_THE_ROBOT)):
        if connection.lost:
            return
        yield await ask(method)
    joints, pose = answers["getJointPositions"], answers["getTcpPose"]
    if isinstance(joints, list) and isinstance(pose, list):
        yield await ask(f"{robot}.RobotAlgorithm.forwardKinematics", {"q": joints})
        yield await ask(f"{robot}.RobotAlgorithm.inverseKinematics", {"qnear": joints, "pose": pose})
    yield await ask(f"{robot}.Trace.peek", {"num": MESSAGES, "last_time": 0})


async def _exchange(connection: RpcConnection, method: str, params: dict[str, Any] | None) -> Exchange:
    loop = asyncio.get_running_loop()
    began = loop.time()
    try:
        answer: dict[str, Any] = {"result": await connection.call(method, params)}
    except RpcError as error:
        answer = {"error": {"code": error.code, "message": error.message}}
    except DeviceTimeout as error:
        answer = {"silence": error.what}
    except ConnectionLost as error:
        answer = {"lost": error.what}
    except DeviceError as error:
        answer = {"refused": error.what}
    return Exchange(method, params, answer, (loop.time() - began) * 1e3)


async def rtde_answers(host: str, port: int) -> dict[str, Any]:
    """What RTDE offers by name, and the newest sample of pose and joints; `refused` says why something is missing."""
    stream = RtdeStream(host, port)
    answers: dict[str, Any] = {}
    try:
        await stream.open((POSE_SEGMENT, JOINTS_SEGMENT), 50.0)
        answers["offered"] = stream.offered
        answers["sample"] = await stream.newest()
    except DeviceError as error:
        answers |= {"offered": stream.offered, "refused": str(error)}
    finally:
        await stream.close()
    return answers
