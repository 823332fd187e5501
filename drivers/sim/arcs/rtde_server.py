"""The loopback controller's RTDE port: it greets, and pushes samples to subscribers at the frequency they ask for."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from brushloop.drivers.arcs.framing import FrameDecoder, encode_short
from brushloop.drivers.arcs.rtde import MAX_MESSAGE_BYTES, PING, SET_RECIPE, decode_message, encode_sample
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.geometry import to_wire
from brushloop.drivers.sim.arcs.cabinet import Cabinet
from brushloop.drivers.sim.arm.motion import Rest
from brushloop.drivers.sim.faults.board import FaultBoard
from brushloop.drivers.sim.faults.kinds import KINDS, Device
from brushloop.drivers.sim.faults.phases import Truth
from brushloop.drivers.sim.server import LoopbackServer

MAX_HZ = 500.0
BACKLOG_BYTES = 32 * 1024
"""A client that does not read is sent nothing more until it has caught up."""
MALFORMED = b"\xff\x81"
"""A CBOR break instead of a value: neither CBOR nor JSON."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One client's subscription on one channel."""

    chanel: int
    period_s: float
    segments: tuple[str, ...]


class RtdeServer(LoopbackServer):
    """One RTDE port for any number of clients."""

    def __init__(self, cabinet: Cabinet) -> None:
        super().__init__()
        self.faults = FaultBoard(Truth(cabinet.world))
        """Faults of this server; a rig shares one board among all its servers."""
        self._cabinet = cabinet
        self.pings = 0
        """Keep-alives seen, for tests."""
        self._outputs: dict[str, tuple[int, Callable[[], Any]]] = {
            "timestamp": (100, cabinet.now_s),
            "R1_actual_q": (1006, lambda: list(cabinet.joints())),
            "R1_robot_mode": (1014, lambda: cabinet.power.mode.value),
            "R1_safety_mode": (1015, lambda: cabinet.power.safety.value),
            "R1_actual_TCP_pose": (1021, lambda: to_wire(cabinet.tcp())),
        }

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Greet the client, then serve its topics until it disconnects."""
        outputs = {name: ident for name, (ident, _) in self._outputs.items()}
        hello = {"protocol": "rtde", "version": 1, "input": {"set_recipe": SET_RECIPE}, "output": outputs}
        writer.write(json.dumps(hello, separators=(",", ":")).encode() + b"\n\n")
        decoder = FrameDecoder(skip=PING, max_bytes=MAX_MESSAGE_BYTES)
        pushes: dict[int, asyncio.Task[None]] = {}
        try:
            while data := await reader.read(65536):
                self.pings += data.count(PING)
                for payload in decoder.feed(data):
                    topic = topic_of(payload)
                    if (old := pushes.pop(topic.chanel, None)) is not None:
                        old.cancel()
                    if topic.period_s > 0.0 and all(name in self._outputs for name in topic.segments):
                        pushes[topic.chanel] = asyncio.create_task(self._push(topic, writer), name="rtde push")
        finally:
            for task in pushes.values():
                task.cancel()
            await asyncio.gather(*pushes.values(), return_exceptions=True)

    async def _push(self, topic: Topic, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        due, before_s = loop.time(), self._cabinet.now_s()
        while not writer.is_closing():
            now_s = self._cabinet.now_s()
            if writer.transport.get_write_buffer_size() < BACKLOG_BYTES:
                for rest in self._rests(before_s, now_s):
                    self._push_once(topic, writer, rest)
                self._push_once(topic, writer)
            before_s = now_s
            due = max(due + topic.period_s, loop.time())
            await asyncio.sleep(due - loop.time())

    def _rests(self, after_s: float, until_s: float) -> list[Rest]:
        """Rests of the arm between two pushes. With fast simulated time a whole press might pass between them."""
        world = self._cabinet.world
        world.motion.advance(until_s)
        return [rest for rest in world.motion.rests if after_s < rest.at_s <= until_s] if world.clock.rate > 1.0 else []

    def _value(self, name: str, rest: Rest | None) -> Any:
        if rest is not None:
            match name:
                case "timestamp":
                    return rest.at_s
                case "R1_actual_TCP_pose":
                    return to_wire(self._cabinet.configured(rest.pose))
                case "R1_actual_q":
                    return list(self._cabinet.motion.near_joints(rest.pose))
                case _:
                    pass
        return self._outputs[name][1]()

    def _push_once(self, topic: Topic, writer: asyncio.StreamWriter, rest: Rest | None = None) -> None:
        fault = self.faults.meet(Device.TELEMETRY, "push", KINDS[Device.TELEMETRY])
        match fault.kind if fault is not None else "":
            case "mute":
                pass
            case "malformed":
                writer.write(encode_short(MALFORMED))
            case "drop":
                writer.close()
            case kind:
                sample = encode_sample(topic.chanel, [self._value(name, rest) for name in topic.segments])
                late_s = fault.late_s if fault is not None and kind == "late" else 0.0
                asyncio.get_running_loop().call_later(late_s, self._send, writer, sample)

    @staticmethod
    def _send(writer: asyncio.StreamWriter, sample: bytes) -> None:
        if not writer.is_closing():
            writer.write(sample)


def topic_of(payload: bytes) -> Topic:
    """The subscription in a payload; a period of 0 if the client unsubscribes. Raises `ProtocolViolation`."""
    match decode_message(payload, "rtde"):
        case (100, [{"chanel": int(chanel), "frequency": float() | int() as hz, "segments": list(names)}]):  # pyright: ignore[reportUnknownVariableType]
            wanted = tuple(str(name) for name in names)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            return Topic(chanel, 1.0 / min(hz, MAX_HZ) if hz > 0 and wanted else 0.0, wanted)
        case other:
            raise ProtocolViolation("rtde", "topic", f"not a topic: {other!r}")
