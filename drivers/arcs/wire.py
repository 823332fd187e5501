"""What goes over the wire of ARCS, and one JSON-RPC connection to a controller, one request outstanding at a time.

`sof` is the framing of the maker's client: SOF frames (`53 4F 46`, a flag byte, a big-endian length, a payload), named
params, string ids, a login. `bare` is what the maker documents: one JSON document after another with nothing between
them, positional params, integer ids, no login.

| flag | length | who sends it |
|---|---|---|
| 0x01 | uint32 | the maker's RPC client, always; this driver too |
| 0x00 | uint16 | the maker's RTDE client |

The end of a bare document is found by its brackets: parsing again and again until it succeeds would take quadratic time
on a reply that comes in small pieces, and could not tell a reply that is cut off from one that is wrong.
"""

import asyncio
import contextlib
import json
import re
import struct
import uuid
from collections.abc import AsyncGenerator, Mapping
from typing import Any, Literal

from pydantic import FiniteFloat, TypeAdapter, ValidationError

from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    NotConnected,
    ProtocolViolation,
    RpcError,
)

DEVICE = "robot"
MAGIC = b"SOF"
HEADERS = {0x01: struct.Struct(">4xI"), 0x00: struct.Struct(">4xH")}
"""The length behind magic and flag, by the flag."""
PING = b"__ping__\0"
"""Keep-alive of the maker's RTDE client, passed over between two payloads."""
MAX_BYTES = 1024 * 1024
"""Far above any reply of a controller; a hostile length must not make the host allocate gigabytes."""


def encode_short(payload: bytes) -> bytes:
    """One frame with a 16-bit length, as RTDE uses. Raises `struct.error` where the payload does not fit."""
    return MAGIC + struct.pack(">BH", 0x00, len(payload)) + payload


def encode(payload: bytes) -> bytes:
    """One frame with a 32-bit length."""
    return MAGIC + struct.pack(">BI", 0x01, len(payload)) + payload


_BETWEEN = re.compile(rb"(?:[ \t\r\n]|%b)*+" % PING)
"""What may come between two payloads."""
_TOKEN = re.compile(rb'[{}\[\]]|"(?:[^"\\]|\\.)*+("?)', re.DOTALL)
"""A bracket or a string, whose end is the group: empty if it has not arrived."""


class Decoder:
    """Turns a byte stream, split at any point, into its payloads: those of SOF frames, and bare JSON documents."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._at = 0
        """Up to where a document at the beginning of the buffer has been searched for its end."""
        self._open = 0
        """Number of its brackets before `_at` that are not closed."""

    def feed(self, data: bytes) -> list[bytes]:
        """What `data` completes, in order.

        Raises `ProtocolViolation` for bytes outside both formats: neither this `data` nor anything after it can be
        trusted, and the connection must be ended.
        """
        self._buffer += data
        payloads: list[bytes] = []
        while (span := self._next()) is not None:
            payloads.append(bytes(self._buffer[span]))
            del self._buffer[: span.stop]
        return payloads

    def _next(self) -> slice | None:
        """Where the first whole payload in the buffer lies; None while it is incomplete."""
        buffer = self._buffer
        if self._open == 0:
            if (between := _BETWEEN.match(buffer)) is not None:
                del buffer[: between.end()]
            if PING.startswith(bytes(buffer[: len(PING)])):
                return None
        return self._document() if buffer[0] in b"{[" else self._frame()

    def _frame(self) -> slice | None:
        buffer = self._buffer
        if not MAGIC.startswith(bytes(buffer[:3])):
            raise _violation(f"expected SOF or JSON, got {bytes(buffer[:8])!r}")
        if len(buffer) < 4:
            return None
        if buffer[3] not in HEADERS:
            raise _violation(f"unknown SOF flag {buffer[3]:#04x}")
        header = HEADERS[buffer[3]]
        if len(buffer) < header.size:
            return None
        (size,) = header.unpack_from(buffer)
        if size > MAX_BYTES:
            raise _violation(f"frame of {size} bytes exceeds {MAX_BYTES}")
        end = header.size + size
        return slice(header.size, end) if len(buffer) >= end else None

    def _document(self) -> slice | None:
        end = self._end_of_document()
        if (end or len(self._buffer)) > MAX_BYTES:
            raise _violation(f"document exceeds {MAX_BYTES} bytes")
        return None if end is None else slice(end)

    def _end_of_document(self) -> int | None:
        """Continue where the last piece ended; return the end of the document, or None if it has not arrived."""
        buffer = self._buffer
        while (token := _TOKEN.search(buffer, self._at)) is not None:
            if token.group(1) == b"":
                self._at = token.start()
                return None
            byte, self._at = buffer[token.start()], token.end()
            if byte in b"{[":
                self._open += 1
            elif byte in b"}]":
                self._open -= 1
                if self._open == 0:
                    end, self._at = self._at, 0
                    return end
        self._at = len(buffer)
        return None


def _violation(what: str) -> ProtocolViolation:
    return ProtocolViolation(DEVICE, "decode", what)


NUMBERS = TypeAdapter(list[FiniteFloat])


def numbers(op: str, values: object, count: int = 6) -> list[float]:
    """`values` of the answer to `op` as floats. Raises `ProtocolViolation` unless it is a list of finite numbers.

    JSON allows integers too large for a float, and a string of six digits is not a pose.
    """
    try:
        floats = NUMBERS.validate_python(values, strict=True)
    except ValidationError:
        floats = []
    if len(floats) != count:
        raise ProtocolViolation(DEVICE, op, f"expected {count} finite numbers, got {str(values)[:80]!r}")
    return floats


PARAMETERS: dict[str, tuple[str, ...]] = {
    "MotionControl.moveJoint": ("q", "a", "v", "blend_radius", "duration"),
    "MotionControl.moveLine": ("pose", "a", "v", "blend_radius", "duration"),
    "MotionControl.setSpeedFraction": ("fraction",),
    "MotionControl.stopLine": ("acc", "acc_rot"),
    "MotionControl.stopMove": ("quick", "all_tasks"),
    "RobotAlgorithm.forwardKinematics": ("q",),
    "RobotAlgorithm.inverseKinematics": ("qnear", "pose"),
    "RobotConfig.setCollisionLevel": ("level",),
    "RobotConfig.setPayload": ("m", "cog", "aom", "inertia"),
    "RobotConfig.setTcpOffset": ("offset",),
    "RobotManage.setOperationalMode": ("mode",),
    "Trace.peek": ("num", "last_time"),
}
"""Parameter names by `Class.method`, without the robot's name. A method that is not listed takes none."""


def parameters(method: str) -> tuple[str, ...]:
    """The parameter names of `method` in the maker's order, with or without the robot's name in front."""
    return PARAMETERS.get(".".join(method.split(".")[-2:]), ())


Framing = Literal["sof", "bare"]
AUBOPE_PORT = 8899
"""Where a cabinet of the generation before ARCS listens."""
SDK_INTERFACE_VERSION = "0.24.0"
# What the vendor's client 0.24.1 sends for the factory account; its obfuscation of other passwords is not known.
FACTORY_LOGIN_TOKEN = "3353545435353664345433434443435463466335333566235443434253142434333426365553"


def encode_request(ident: str, method: str, params: Mapping[str, object] | None) -> bytes:
    """Compact JSON with sorted keys; `params` is left out where there are none, as the vendor's client does."""
    body: dict[str, object] = {"id": ident, "jsonrpc": "2.0", "method": method}
    if params:
        body["params"] = dict(params)
    return json.dumps(body, separators=(",", ":"), sort_keys=True).encode()


def encode_bare_request(ident: int, method: str, params: Mapping[str, object] | None) -> bytes:
    """A request as the maker documents it. Raises ValueError for a missing or unknown parameter."""
    names, by_name = parameters(method), params or {}
    if set(names) != set(by_name):
        raise ValueError(f"{method} takes {names}, got {tuple(by_name)}")
    values = [by_name[name] for name in names]
    body = {"jsonrpc": "2.0", "method": method, "params": values, "id": ident}
    return json.dumps(body, separators=(",", ":")).encode()


@contextlib.asynccontextmanager
async def in_time(device: str, op: str, seconds: float, awaited: str) -> AsyncGenerator[None]:
    """Raise `DeviceTimeout` if the block takes longer, and `ConnectionLost` if the peer refuses or hangs up."""
    try:
        async with asyncio.timeout(seconds):
            yield
    except DeviceError:
        raise
    except TimeoutError:
        raise DeviceTimeout(device, op, f"no {awaited} in {seconds:g} s") from None
    except (OSError, EOFError) as error:
        raise ConnectionLost(device, op, f"no {awaited}: {getattr(error, 'strerror', None) or error}") from None


Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]
REPLY_S = 1.0
"""Longest wait for a reply, and for a connection."""


class RpcConnection:
    """A socket with one caller at a time; late replies to calls that timed out are passed over."""

    def __init__(self, host: str, port: int, *, framing: Framing = "sof") -> None:
        self.host = host
        self.port = port
        self._framing = framing
        self._last_id = 0
        self._lock = asyncio.Lock()
        self._stream: Stream | None = None
        self._decoder = Decoder()
        self._lost: str | None = None
        """Why nothing more is read from the connection."""

    @property
    def lost(self) -> bool:
        """True from the moment the peer went away until `close` or a successful `open`."""
        if self._lost is None and self._stream is not None:
            reader, _ = self._stream
            if reader.at_eof() or reader.exception() is not None:
                self._lost = str(reader.exception() or "the controller closed the connection")
        return self._lost is not None

    async def open(self, *, login: bool = True) -> None:
        """Connect and log in with the factory account, which bare clients do not; closes what was open before.

        Raises `ConnectionLost` (refused) or `DeviceTimeout`. Then it counts as lost, so that its next user opens it.
        """
        await self.close()
        try:
            async with in_time(DEVICE, "connect", REPLY_S, f"answer from {self.host}:{self.port}"):
                self._stream = await asyncio.open_connection(self.host, self.port)
            self._decoder = Decoder()
            if login and self._framing == "sof":
                token = f"__login__\naubo\n{FACTORY_LOGIN_TOKEN}\n{SDK_INTERFACE_VERSION}\n"
                await self._exchange("", "login", encode(token.encode()))
        except BaseException:
            await self.close()
            self._lost = f"{self.host}:{self.port} was not opened"
            raise

    async def call(self, method: str, params: Mapping[str, object] | None = None) -> Any:
        """The result of `method`. Raises `RpcError`, `DeviceTimeout`, `ConnectionLost`, `ProtocolViolation`."""
        if self._framing == "bare":
            self._last_id += 1
            return await self._exchange(self._last_id, method, encode_bare_request(self._last_id, method, params))
        ident = str(uuid.uuid4())[:18]  # of the shape of the vendor client's ids: 8-4-4 characters
        return await self._exchange(ident, method, encode(encode_request(ident, method, params)))

    async def close(self) -> None:
        """Close the socket; a call that still waits gets `NotConnected`."""
        stream, self._stream, self._lost = self._stream, None, None
        if stream is not None:
            stream[1].close()
            with contextlib.suppress(OSError):
                await stream[1].wait_closed()

    async def _exchange(self, ident: str | int, op: str, request: bytes) -> Any:
        async with self._lock:
            if self.lost:
                raise ConnectionLost(DEVICE, op, str(self._lost))
            if self._stream is None:
                raise NotConnected(DEVICE, op, "not connected")
            # No drain: requests are small, and a socket that cannot be written to fails the reader.
            self._stream[1].write(request)
            async with in_time(DEVICE, op, REPLY_S, "reply"):
                return await self._reply(ident, op, self._stream)

    async def _reply(self, ident: str | int, op: str, stream: Stream) -> Any:
        """Read until the call is answered. Bytes out of step end the connection: nothing after them can be trusted."""
        while True:
            try:
                data = await stream[0].read(65536)
                payloads = self._decoder.feed(data)
                why = "" if data else "the controller closed the connection"
            except ProtocolViolation as error:
                payloads, why = [], error.what
            except OSError as error:
                payloads, why = [], error.strerror or str(error)
            for payload in payloads:
                if (answer := answer_in(payload, ident, op)) is not None:
                    return answer.get("result")
            if self._stream is not stream:
                raise NotConnected(DEVICE, op, "closed while waiting")
            if why:
                self._lost = why
                raise ConnectionLost(DEVICE, op, why)


def answer_in(payload: bytes, ident: str | int, op: str) -> dict[str, Any] | None:
    """The reply with the call's id; None for that of another call. The login, whose id is empty, takes any reply.

    Raises `RpcError` for an error object, `ProtocolViolation` for what is neither result nor error.
    """
    if ident == "":
        return {}
    try:
        reply: Any = json.loads(payload)
    except (ValueError, RecursionError):
        raise ProtocolViolation(DEVICE, op, f"reply is not JSON: {payload[:40]!r}") from None
    if not isinstance(reply, dict):
        return None
    answer: dict[str, Any] = reply  # pyright: ignore[reportUnknownVariableType]
    echo = answer.get("id")
    if type(echo) is not type(ident) or echo != ident:  # True equals 1
        return None
    match answer.get("error"):
        case {"code": int(code), "message": str(message)}:
            raise RpcError(DEVICE, op, code, message)
        case None if "result" in answer:
            return answer
        case other:
            raise ProtocolViolation(DEVICE, op, f"neither result nor error: {other!r}")


async def open_arcs(connection: RpcConnection) -> None:
    """Open the connection. Raises as `open` does, or a `DeviceError` that says that the cabinet runs older software."""
    try:
        await connection.open()
    except (ConnectionLost, DeviceTimeout) as error:
        if error.op == "connect" and await answers(connection.host, AUBOPE_PORT):
            what = f"port {connection.port} does not answer but {AUBOPE_PORT} does: this cabinet runs AUBOPE (V4)"
            remedy = "The cabinet needs the ARCS software; ask the maker for the upgrade."
            raise DeviceError(DEVICE, "connect", what, remedy=remedy) from None
        raise


async def answers(host: str, port: int) -> bool:
    """Whether anything listens there."""
    try:
        async with asyncio.timeout(1.0):
            _, writer = await asyncio.open_connection(host, port)
    except OSError:
        return False
    writer.close()
    return True
