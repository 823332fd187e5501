"""The loopback controller: ARCS JSON-RPC over TCP, written from what the vendor's client was seen to do.

It keeps the parts that a driver can get wrong: power states that take time, a motion queue with ids, refusals
by return code, a steady flag that lags. It fakes no accuracy and no safety function.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from typing import Any

from drivers.arcs.codes import LOOPBACK_CONTROL_BOX, MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from drivers.arcs.frames import FrameDecoder, encode
from drivers.geometry import from_wire, to_wire
from drivers.sim.server import LoopbackServer
from drivers.sim.world import World

ROBOT = "rob1"
INTERFACE_VERSION = 24000
POWER_ON_S = 1.0
BRAKE_RELEASE_S = 1.0
REACH_MM = 886.5
"""a2 + a3 + d5 of the i5; beyond it a pose is accepted first and fails in planning."""

Params = dict[str, Any]


class ArcsServer(LoopbackServer):
    """One controller for any number of clients."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world
        self._mode_at: list[tuple[float, RobotMode]] = [(-1.0, RobotMode.POWER_OFF)]
        self.safety = SafetyMode.NORMAL
        self.mute = False
        """While True, requests are read and never answered (a fault that tests script)."""
        self.mute_to: set[str] = set()
        """Methods that are carried out but never answered (a fault that tests script)."""
        self.tcp_offset: list[float] = [0.0] * 6
        self.messages: list[dict[str, Any]] = []
        self._methods: dict[str, Callable[[Params], Any]] = {
            "SystemInfo.getInterfaceVersionCode": lambda _: INTERFACE_VERSION,
            "getRobotNames": lambda _: [ROBOT],
            "getAxisNames": lambda _: [],
            "RuntimeMachine.abort": lambda _: self._stop(2.0, 2.0),
            f"{ROBOT}.RobotConfig.getRobotType": lambda _: "aubo_i5",
            f"{ROBOT}.RobotConfig.getControlBoxType": lambda _: LOOPBACK_CONTROL_BOX,
            f"{ROBOT}.RobotConfig.setTcpOffset": self._set_tcp_offset,
            f"{ROBOT}.RobotConfig.getTcpOffset": lambda _: self.tcp_offset,
            f"{ROBOT}.RobotManage.poweron": lambda _: self._power_on(),
            f"{ROBOT}.RobotManage.startup": lambda _: self._start_up(),
            f"{ROBOT}.RobotManage.poweroff": lambda _: self._power_off(),
            f"{ROBOT}.RobotState.getRobotModeType": lambda _: self.mode.value,
            f"{ROBOT}.RobotState.getSafetyModeType": lambda _: self.safety.value,
            f"{ROBOT}.RobotState.getTcpPose": lambda _: to_wire(self._world.tool()),
            f"{ROBOT}.RobotState.isSteady": lambda _: self._world.motion.steady(self._now_s),
            f"{ROBOT}.MotionControl.getExecId": lambda _: self._world.motion.exec_id(self._now_s),
            f"{ROBOT}.MotionControl.moveLine": self._move_line,
            f"{ROBOT}.MotionControl.stopLine": lambda p: self._stop(float(p["acc"]), float(p["acc_rot"])),
            f"{ROBOT}.MotionControl.clearPath": lambda _: self._stop(2.0, 2.0),
            f"{ROBOT}.Trace.peek": lambda p: self.messages[-int(p["num"]) :],
        }

    def protective_stop(self, mode: SafetyMode = SafetyMode.PROTECTIVE_STOP) -> None:
        """Enter a safety stop where the arm is (a fault that tests script); only a person clears it."""
        self.safety = mode
        self._stop(10.0, 10.0)

    @property
    def mode(self) -> RobotMode:
        """The robot mode now; transitions become true when their time has come."""
        while len(self._mode_at) > 1 and self._mode_at[1][0] <= self._now_s:
            self._mode_at.pop(0)
        return self._mode_at[0][1]

    @property
    def _now_s(self) -> float:
        return self._world.clock.now_s()

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer requests in order. The motion queue goes on when the client has gone, as a cabinet's would."""
        decoder = FrameDecoder()
        while data := await reader.read(65536):
            for payload in decoder.feed(data):
                if not self.mute and (answer := self._answer(payload)):
                    writer.write(encode(answer))
            await writer.drain()

    def _answer(self, payload: bytes) -> bytes | None:
        if payload.startswith(b"__login__"):
            return b"SUCCEED"
        ident: object = None
        try:
            request = json.loads(payload)
        except ValueError as error:
            return _error(ident, -32700, f"parse error: {error}")
        try:
            ident = request["id"]
            method = self._methods.get(str(request["method"]))
            if method is None:
                return _error(ident, -32601, f"method not found: {request['method']}")
            result = method(request.get("params") or {})
            if request["method"] in self.mute_to:
                return None
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            return _error(ident, -32602, f"invalid params: {error!r}")
        return json.dumps({"id": ident, "jsonrpc": "2.0", "result": result}).encode()

    def _set_tcp_offset(self, params: Params) -> int:
        offset = [float(v) for v in params["offset"]]
        if len(offset) != 6:
            return -ReturnCode.INVALID_ARGUMENT
        self.tcp_offset = offset
        return ReturnCode.OK

    def _power_on(self) -> int:
        if self.mode == RobotMode.POWER_OFF:
            self._mode_at = [(self._now_s, RobotMode.BOOTING), (self._now_s + POWER_ON_S, RobotMode.IDLE)]
        return ReturnCode.OK

    def _start_up(self) -> int:
        if self.mode != RobotMode.IDLE:
            return ReturnCode.BAD_STATE
        self._mode_at = [
            (self._now_s, RobotMode.BRAKE_RELEASING),
            (self._now_s + BRAKE_RELEASE_S, RobotMode.RUNNING),
        ]
        return ReturnCode.OK

    def _power_off(self) -> int:
        self._stop(10.0, 10.0)
        self._mode_at = [(self._now_s, RobotMode.POWER_OFF)]
        return ReturnCode.OK

    def _move_line(self, params: Params) -> int:
        target = from_wire([float(v) for v in params["pose"]])
        acc_m_s2, speed_m_s = float(params["a"]), float(params["v"])
        if self.mode != RobotMode.RUNNING:
            return -1
        if self.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        if acc_m_s2 <= 0.0 or speed_m_s <= 0.0:
            return -ReturnCode.INVALID_ARGUMENT
        if self._world.motion.full:
            return ReturnCode.QUEUE_FULL
        if math.dist(target.position_mm, (0.0, 0.0, 0.0)) > REACH_MM:
            self.messages.append({"code": 30047, "level": "ERROR", "source": ROBOT, "args": [], "timestamp": 0})
            return ReturnCode.OK
        added = self._world.motion.add(target, speed_m_s * 1e3, acc_m_s2 * 1e3, self._now_s)
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def _stop(self, acc_m_s2: float, acc_rad_s2: float) -> int:
        if acc_m_s2 <= 0.0 or acc_rad_s2 <= 0.0:
            return -ReturnCode.INVALID_ARGUMENT
        self._world.motion.stop(acc_m_s2 * 1e3, acc_rad_s2, self._now_s)
        return ReturnCode.OK


def _error(ident: object, code: int, message: str) -> bytes:
    return json.dumps({"id": ident, "jsonrpc": "2.0", "error": {"code": code, "message": message}}).encode()
