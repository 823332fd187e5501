"""The loopback controller on the wire: ARCS JSON-RPC, written from observations of the maker's client, and RTDE.

One port takes SOF frames and bare JSON, named and positional params, ids of any kind; a connection's first byte decides
its framing. The RTDE port greets, and pushes samples to subscribers at the frequency they ask for.
"""

import asyncio
import json
from collections.abc import Callable
from typing import Any, cast

from brushloop.drivers.arcs.telemetry import SET_RECIPE, decode_message, encode_sample
from brushloop.drivers.arcs.wire import PING, Decoder, encode, parameters
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.geometry import to_wire
from brushloop.drivers.loopback import LoopbackServer
from brushloop.drivers.sim.cabinet import Cabinet, methods
from brushloop.drivers.sim.faults import STOPS, Device, Fault, FaultBoard
from brushloop.drivers.sim.world import World

PIECE_S = 0.001
CUTS = (2, 4, 3)
"""Lengths of the first pieces of a split frame: it is cut in the magic bytes, in the length, and after the head."""
GARBAGE = b"\x00\xffnothing that anyone speaks\r\n"


async def send(
    writer: asyncio.StreamWriter, frame: Callable[[bytes], bytes], answer: bytes, fault: Fault | None
) -> None:
    """Send a reply in its frame, as a fault changes it. Raises ConnectionError where the fault is `drop`."""
    kind, whole = "" if fault is None else fault.kind, frame(answer)
    match kind:
        case "mute":
            return
        case "drop":
            raise ConnectionResetError("the connection is to be closed without an answer")
        case "late":
            assert fault is not None
            asyncio.get_running_loop().call_later(fault.late_s, LoopbackServer.write, writer, whole)
            return
        case "split":
            for cut in (*CUTS, len(whole) // 2):
                if cut < len(whole):
                    writer.write(whole[:cut])
                    whole = whole[cut:]
                    await writer.drain()
                    await asyncio.sleep(PIECE_S)
        case "duplicate":
            whole *= 2
        case "wrong-id":
            whole = frame(_with_another_id(answer))
        case "malformed":
            whole = frame(answer[: len(answer) // 2])
        case "garbage":
            whole = GARBAGE
        case _:
            pass
    # In one piece: the vendor's client never recovers from a header that arrives in two.
    writer.write(whole)
    await writer.drain()


def _with_another_id(answer: bytes) -> bytes:
    """A valid reply to another request; the login's reply is no JSON, and becomes one."""
    body: dict[str, Any] = json.loads(answer) if answer.startswith(b"{") else {"jsonrpc": "2.0", "result": 0}
    return json.dumps({**body, "id": "ZZZZZZZZ-ZZZZ-ZZZZ"}, separators=(",", ":")).encode()


INVALID_REQUEST, METHOD_NOT_FOUND, INVALID_PARAMS = -32600, -32601, -32602


class ArcsServer(LoopbackServer):
    """One controller for any number of clients."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self.cabinet = Cabinet(world)
        self.faults = FaultBoard(world)
        self._methods = methods(self.cabinet)

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer requests in order. The motion queue continues after the client disconnects, as a cabinet's would."""
        data = await reader.read(65536)
        bare = data[:1] in (b"{", b"[", b" ", b"\t", b"\r", b"\n")
        decoder = Decoder()
        while data:
            for payload in decoder.feed(data):
                request = request_of(payload)
                op = request.get("method", "")
                fault = self.faults.meet(Device.ROBOT, op)
                if fault is not None and fault.kind == "deaf":
                    continue  # the request never arrived: it is neither carried out nor answered
                answer = b"SUCCEED" if op == "login" else self._answer(request)
                if fault is not None and fault.kind in STOPS:
                    self.cabinet.safety_stop(STOPS[fault.kind])
                await send(writer, bytes if bare else encode, answer, fault)
            data = await reader.read(65536)

    def _answer(self, request: dict[str, Any]) -> bytes:
        """Carry out a request, and reply."""
        ident, name, params = (request.get(field) for field in ("id", "method", "params"))
        if name is None:
            return _error(ident, INVALID_REQUEST, "a request must be a JSON object with a method")
        if name not in self._methods:
            return _error(ident, METHOD_NOT_FOUND, f"method not found: {name}")
        try:
            by_name: dict[str, Any] = params or {}
            if isinstance(params, list):
                by_name = dict(zip(parameters(name), params, strict=True))  # pyright: ignore[reportUnknownArgumentType]
            result = self._methods[name](by_name)
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            return _error(ident, INVALID_PARAMS, f"invalid params: {error!r}")
        return _reply(ident, result=result)


def request_of(payload: bytes) -> dict[str, Any]:
    """A request by its fields; none where it is no object with a method. A login has only the method `login`.

    Raises ValueError where it is no JSON.
    """
    if payload.startswith(b"__login__"):
        return {"method": "login"}
    match json.loads(payload):
        case {"method": str()} as request:
            return request  # pyright: ignore[reportUnknownVariableType]
        case _:
            return {}


def _reply(ident: object, **body: object) -> bytes:
    return json.dumps({"id": ident, "jsonrpc": "2.0", **body}, separators=(",", ":")).encode()


def _error(ident: object, code: int, message: str) -> bytes:
    return _reply(ident, error={"code": code, "message": message})


OUTPUTS: dict[str, tuple[int, Callable[[Cabinet, float, Pose], Any]]] = {
    "timestamp": (100, lambda _box, at_s, _tip: at_s),
    "R1_actual_q": (1006, lambda box, _at_s, tip: list(box.motion.near_joints(tip))),
    "R1_robot_mode": (1014, lambda box, _at_s, _tip: box.power.mode.value),
    "R1_safety_mode": (1015, lambda box, _at_s, _tip: box.power.safety.value),
    "R1_actual_TCP_pose": (1021, lambda box, _at_s, tip: to_wire(box.configured(tip))),
}
"""Identifier of each output that a client may subscribe to, and its value at a time with the tip there."""
MAX_HZ = 500.0


class RtdeServer(LoopbackServer):
    """The RTDE port of a controller for any number of clients."""

    def __init__(self, arcs: ArcsServer) -> None:
        super().__init__()
        self.faults = arcs.faults
        self._cabinet = arcs.cabinet
        self.pings = 0
        """Keep-alives seen, for tests."""

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Greet the client, then serve its topics until it disconnects."""
        idents = {name: ident for name, (ident, _) in OUTPUTS.items()}
        hello = {"protocol": "rtde", "version": 1, "input": {"set_recipe": SET_RECIPE}, "output": idents}
        writer.write(json.dumps(hello, separators=(",", ":")).encode() + b"\n\n")
        decoder = Decoder()
        pushes: dict[int, asyncio.Task[None]] = {}
        try:
            while data := await reader.read(65536):
                self.pings += data.count(PING)
                for payload in decoder.feed(data):
                    chanel, hz, names = topic_of(payload)
                    if (old := pushes.pop(chanel, None)) is not None:
                        old.cancel()
                    if hz > 0.0 and names and OUTPUTS.keys() >= set(names):
                        push = self._push(chanel, 1.0 / min(hz, MAX_HZ), names, writer)
                        pushes[chanel] = asyncio.create_task(push, name="rtde push")
        finally:
            for task in pushes.values():
                task.cancel()
            await asyncio.gather(*pushes.values(), return_exceptions=True)

    async def _push(self, chanel: int, period_s: float, names: list[str], writer: asyncio.StreamWriter) -> None:
        loop, world = asyncio.get_running_loop(), self._cabinet.world
        due, before_s = loop.time(), self._cabinet.now_s()
        while not writer.is_closing():
            now_s, tip = self._cabinet.now_s(), world.tool()
            # With fast simulated time a whole press might pass between two pushes: rests are pushed too.
            rests = world.motion.rests if world.clock.rate > 1.0 else ()
            passed = [(rest.at_s, rest.pose) for rest in rests if before_s < rest.at_s <= now_s]
            for at_s, pose in (*passed, (now_s, tip)):
                fault = self.faults.meet(Device.TELEMETRY)
                late_s = 0.0 if fault is None else fault.late_s
                if fault is None or fault.kind != "mute":
                    sample = encode_sample(chanel, [OUTPUTS[name][1](self._cabinet, at_s, pose) for name in names])
                    loop.call_later(late_s, self.write, writer, sample)
            before_s = now_s
            await writer.drain()  # a client that does not read is sent nothing more until it has caught up
            due = max(due + period_s, loop.time())
            await asyncio.sleep(due - loop.time())


def topic_of(payload: bytes) -> tuple[int, float, list[str]]:
    """Channel, frequency in Hz and outputs of a subscription; 0 Hz, or no output, to unsubscribe.

    Raises `ProtocolViolation`.
    """
    match decode_message(payload):
        case (100, [{"chanel": int(chanel), "frequency": float() | int() as hz, "segments": list(names)}]):  # pyright: ignore[reportUnknownVariableType]
            return chanel, hz, [str(name) for name in cast("list[Any]", names)]
        case other:
            raise ProtocolViolation("rtde", "topic", f"not a topic: {other!r}")
