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

from __future__ import annotations

import abc
import asyncio
import contextlib
import json
import math
import re
import secrets
import struct
from collections.abc import Mapping
from typing import Any, Literal

from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    NotConnected,
    ProtocolViolation,
    RpcError,
    WrongGeneration,
)

MAGIC = b"SOF"
FLAG_LONG = 0x01
FLAG_SHORT = 0x00
MAX_PAYLOAD_BYTES = 16 * 1024 * 1024
"""Far above any reply of a controller; a hostile length must not make the host allocate gigabytes."""


def encode_short(payload: bytes) -> bytes:
    """One frame with a 16-bit length, as RTDE uses. Raises ValueError where the payload does not fit."""
    if len(payload) > 0xFFFF:
        raise ValueError(f"payload of {len(payload)} bytes exceeds 65535")
    return MAGIC + bytes([FLAG_SHORT]) + struct.pack(">H", len(payload)) + payload


def encode(payload: bytes) -> bytes:
    """One frame with a 32-bit length. Raises ValueError above `MAX_PAYLOAD_BYTES`."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload of {len(payload)} bytes exceeds {MAX_PAYLOAD_BYTES}")
    return MAGIC + bytes([FLAG_LONG]) + struct.pack(">I", len(payload)) + payload


class _Decoder(abc.ABC):
    """Turns a byte stream, split at any point, into what `_next` finds at its beginning."""

    def __init__(self, device: str, max_bytes: int) -> None:
        self._device = device
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._broken: str | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """What `data` completes, in order.

        Raises `ProtocolViolation` for bytes outside the format, and then on every later call: neither this `data` nor
        anything after it can be trusted.
        """
        if self._broken is not None:
            raise self._violation(self._broken)
        self._buffer += data
        payloads: list[bytes] = []
        while (payload := self._next()) is not None:
            payloads.append(payload)
        return payloads

    @abc.abstractmethod
    def _next(self) -> bytes | None:
        """Take the next whole item from the buffer; None while it is incomplete."""

    def _violation(self, what: str) -> ProtocolViolation:
        self._broken = what
        self._buffer.clear()
        return ProtocolViolation(self._device, "decode", what)


class FrameDecoder(_Decoder):
    """Turns a byte stream, split at any point, into the payloads of SOF frames."""

    def __init__(self, device: str = "arcs", *, skip: bytes = b"", max_bytes: int = MAX_PAYLOAD_BYTES) -> None:
        """`skip` holds bytes that may appear between frames and are ignored."""
        super().__init__(device, max_bytes)
        self._skip = skip

    def _next(self) -> bytes | None:
        buffer, skip = self._buffer, self._skip
        while skip and buffer.startswith(skip):
            del buffer[: len(skip)]
        if 0 < len(buffer) < len(skip) and skip.startswith(bytes(buffer)):
            return None
        if not MAGIC.startswith(bytes(buffer[:3])):
            raise self._violation(f"expected SOF, got {bytes(buffer[:8])!r}")
        if len(buffer) < 4:
            return None
        match buffer[3]:
            case 0x01:
                head, size = 8, struct.unpack_from(">I", buffer, 4)[0] if len(buffer) >= 8 else None
            case 0x00:
                head, size = 6, struct.unpack_from(">H", buffer, 4)[0] if len(buffer) >= 6 else None
            case flag:
                raise self._violation(f"unknown SOF flag {flag:#04x}")
        if size is None:
            return None
        if size > self._max_bytes:
            raise self._violation(f"frame of {size} bytes exceeds {self._max_bytes}")
        if len(buffer) < head + size:
            return None
        payload = bytes(buffer[head : head + size])
        del buffer[: head + size]
        return payload


MAX_DOCUMENT_BYTES = 1024 * 1024
"""Far above any reply of a controller."""
MAX_DEPTH = 64
"""No reply nests deeper than five; the parser must not run out of stack."""

_STRUCTURE = re.compile(rb'["{}\[\]]')
_STRING_END = re.compile(rb'["\\]')
_CLOSES = {ord("}"): ord("{"), ord("]"): ord("[")}


class BareDecoder(_Decoder):
    """Turns a byte stream, split at any point, into JSON documents, bounded in size and depth.

    NaN and Infinity are accepted, as by Python's `json`.
    """

    def __init__(self, device: str = "arcs", *, max_bytes: int = MAX_DOCUMENT_BYTES) -> None:
        super().__init__(device, max_bytes)
        self._at = 0
        self._open: list[int] = []
        self._in_string = False

    def _next(self) -> bytes | None:
        if not self._open:
            del self._buffer[: len(self._buffer) - len(self._buffer.lstrip(b" \t\r\n"))]
            if self._buffer and self._buffer[0] not in b"{[":
                raise self._violation(f"expected JSON, got {bytes(self._buffer[:8])!r}")
        end = self._scan()
        if (end or len(self._buffer)) > self._max_bytes:
            raise self._violation(f"document exceeds {self._max_bytes} bytes")
        if end is None:
            return None
        document = bytes(self._buffer[:end])
        del self._buffer[:end]
        self._at = 0
        try:
            json.loads(document)
        except (ValueError, RecursionError):
            raise self._violation(f"not JSON: {document[:40]!r}") from None
        return document

    def _scan(self) -> int | None:
        """Continue where the last piece ended; return the end of the document, or None if it has not arrived."""
        buffer = self._buffer
        while True:
            match = (_STRING_END if self._in_string else _STRUCTURE).search(buffer, self._at)
            if match is None:
                self._at = len(buffer)
                return None
            byte, self._at = buffer[match.start()], match.end()
            if byte == ord("\\"):
                if self._at == len(buffer):  # the escaped character has not arrived: scan again from here
                    self._at -= 1
                    return None
                self._at += 1
            elif byte == ord('"'):
                self._in_string = not self._in_string
            elif byte in _CLOSES:
                if self._open.pop() != _CLOSES[byte]:
                    raise self._violation("brackets do not match")
                if not self._open:
                    return self._at
            else:
                self._open.append(byte)
                if len(self._open) > MAX_DEPTH:
                    raise self._violation(f"nested deeper than {MAX_DEPTH}")


def numbers(op: str, values: object, count: int = 6) -> list[float]:
    """`values` of the answer to `op` as floats. Raises `ProtocolViolation` unless it is a list of finite numbers.

    JSON allows integers too large for a float, and a string of six digits is not a pose.
    """
    if not isinstance(values, list):
        raise ProtocolViolation(DEVICE, op, f"expected {count} numbers, got {str(values)[:80]!r}")
    try:
        floats = [float(v) if type(v) in (int, float) else math.nan for v in values]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    except OverflowError:
        floats = []
    if len(floats) != count or not all(map(math.isfinite, floats)):
        got = str(values)[:80]  # pyright: ignore[reportUnknownArgumentType]
        raise ProtocolViolation(DEVICE, op, f"expected {count} finite numbers, got {got}")
    return floats


PARAMETERS: dict[str, tuple[str, ...]] = {
    "MotionControl.moveJoint": ("q", "a", "v", "blend_radius", "duration"),
    "MotionControl.moveLine": ("pose", "a", "v", "blend_radius", "duration"),
    "MotionControl.setSpeedFraction": ("fraction",),
    "MotionControl.stopLine": ("acc", "acc_rot"),
    "MotionControl.stopMove": ("quick", "all_tasks"),
    "RegisterControl.setWatchDog": ("key", "timeout", "action"),
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
    """The parameter names of `method`, with or without the robot's name in front."""
    return PARAMETERS.get(".".join(method.split(".")[-2:]), ())


def positional(method: str, params: Mapping[str, object]) -> list[object]:
    """The values in the maker's order. Raises ValueError for a missing or unknown name."""
    names = parameters(method)
    if set(names) != set(params):
        raise ValueError(f"{method} takes {names}, got {tuple(params)}")
    return [params[name] for name in names]


def named(method: str, values: list[object]) -> dict[str, object]:
    """The values by name. Raises ValueError for the wrong number of them."""
    return dict(zip(parameters(method), values, strict=True))


DEVICE = "robot"
Framing = Literal["sof", "bare"]
AUBOPE_PORT = 8899
"""Where a cabinet of the generation before ARCS listens."""
SDK_INTERFACE_VERSION = "0.24.0"
# What the vendor's client 0.24.1 sends for the factory account; its obfuscation of other passwords is not known.
FACTORY_LOGIN_TOKEN = "3353545435353664345433434443435463466335333566235443434253142434333426365553"


def request_id() -> str:
    """An id of the vendor client's shape: 8-4-4 characters."""
    raw = secrets.token_hex(8)
    return f"{raw[:8]}-{raw[8:12]}-{raw[12:]}"


def encode_request(ident: str, method: str, params: Mapping[str, object] | None) -> bytes:
    """Compact JSON with sorted keys; `params` is left out where there are none, as the vendor's client does."""
    body: dict[str, object] = {"id": ident, "jsonrpc": "2.0", "method": method}
    if params:
        body["params"] = dict(params)
    return json.dumps(body, separators=(",", ":"), sort_keys=True).encode()


def encode_bare_request(ident: int, method: str, params: Mapping[str, object] | None) -> bytes:
    """A request as the maker documents it. Raises ValueError for a parameter that the method does not have."""
    values = positional(method, params or {})
    body = {"jsonrpc": "2.0", "method": method, "params": values, "id": ident}
    return json.dumps(body, separators=(",", ":")).encode()


class RpcConnection:
    """A socket with one caller at a time; late replies to calls that timed out are dropped."""

    def __init__(self, host: str, port: int, *, timeout_s: float = 1.0, framing: Framing = "sof") -> None:
        self.host = host
        self.port = port
        self._timeout_s = timeout_s
        self._framing = framing
        self._last_id = 0
        self._lock = asyncio.Lock()
        self._writer: asyncio.StreamWriter | None = None
        self._reader_task: asyncio.Task[None] | None = None
        self._pending: tuple[str | int, str, asyncio.Future[Any]] | None = None
        self._lost: str | None = None

    @property
    def lost(self) -> bool:
        """True from the moment the peer went away until `close` or a successful `open`."""
        return self._lost is not None

    async def open(self) -> None:
        """Connect. Raises `ConnectionLost` (refused) or `DeviceTimeout`."""
        try:
            async with asyncio.timeout(self._timeout_s):
                reader, writer = await asyncio.open_connection(self.host, self.port)
        except TimeoutError:
            self._lost = f"{self.host}:{self.port} did not answer"
            raise DeviceTimeout(DEVICE, "connect", self._lost) from None
        except OSError as error:
            self._lost = f"{self.host}:{self.port}: {error.strerror or error}"
            raise ConnectionLost(DEVICE, "connect", self._lost) from None
        self._writer = writer
        self._lost = None
        self._reader_task = asyncio.create_task(self._read(reader), name=f"rpc {self.host}:{self.port}")

    async def login(self) -> None:
        """Send the login frame of the factory account and wait for any reply; bare clients have no login."""
        if self._framing == "bare":
            return
        token = f"__login__\naubo\n{FACTORY_LOGIN_TOKEN}\n{SDK_INTERFACE_VERSION}\n"
        await self._exchange("", "login", encode(token.encode()))

    async def call(self, method: str, params: Mapping[str, object] | None = None) -> Any:
        """The result of `method`. Raises `RpcError`, `DeviceTimeout`, `ConnectionLost`, `ProtocolViolation`."""
        if self._framing == "bare":
            self._last_id += 1
            return await self._exchange(self._last_id, method, encode_bare_request(self._last_id, method, params))
        ident = request_id()
        return await self._exchange(ident, method, encode(encode_request(ident, method, params)))

    async def reopen(self) -> None:
        """Close, connect and log in again. Raises what `open` and `login` raise."""
        await self.close()
        try:
            await self.open()
            await self.login()
        except BaseException:
            # A half-open connection counts as lost, so that its next user opens it again.
            await self.close()
            self._lost = "it was not opened again"
            raise

    async def close(self) -> None:
        """End the reader, close the socket; a call that still waits gets `NotConnected`."""
        reader, self._reader_task = self._reader_task, None
        writer, self._writer = self._writer, None
        if reader is not None:
            reader.cancel()
            await asyncio.wait([reader])
        if writer is not None:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
        self._lost = None
        if self._pending is not None and not self._pending[2].done():
            self._pending[2].set_exception(NotConnected(DEVICE, self._pending[1], "closed while waiting"))

    async def _exchange(self, ident: str | int, op: str, request: bytes) -> Any:
        async with self._lock:
            if self._lost is not None:
                raise ConnectionLost(DEVICE, op, self._lost)
            if self._writer is None:
                raise NotConnected(DEVICE, op, "not connected")
            future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
            self._pending = (ident, op, future)
            try:
                # No drain: requests are small, and a socket that cannot be written to fails the reader.
                self._writer.write(request)
                async with asyncio.timeout(self._timeout_s):
                    return await future
            except TimeoutError:
                raise DeviceTimeout(DEVICE, op, f"no reply in {self._timeout_s:g} s") from None
            finally:
                self._pending = None

    async def _read(self, reader: asyncio.StreamReader) -> None:
        decoder = BareDecoder(DEVICE) if self._framing == "bare" else FrameDecoder(DEVICE)
        try:
            while data := await reader.read(65536):
                for payload in decoder.feed(data):
                    self._deliver(payload)
            self._fail("the controller closed the connection")
        except ProtocolViolation as error:
            # Out of step with the stream: nothing after this can be trusted.
            self._fail(error.what)
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _deliver(self, payload: bytes) -> None:
        if self._pending is None:
            return
        ident, op, future = self._pending
        if future.done():
            return
        if ident == "":  # the login reply is not JSON, and its content carries no meaning
            future.set_result(payload)
            return
        try:
            reply = json.loads(payload)
        except (ValueError, RecursionError):
            future.set_exception(ProtocolViolation(DEVICE, op, f"reply is not JSON: {payload[:40]!r}"))
            return
        if not isinstance(reply, dict):
            return
        answer: dict[str, Any] = reply  # pyright: ignore[reportUnknownVariableType]
        echo = answer.get("id")
        if type(echo) is not type(ident) or echo != ident:  # True equals 1
            return
        match answer.get("error"):
            case {"code": int(code), "message": str(message)}:
                future.set_exception(RpcError(DEVICE, op, code, message))
            case None if "result" in answer:
                future.set_result(answer["result"])
            case other:
                future.set_exception(ProtocolViolation(DEVICE, op, f"neither result nor error: {other!r}"))

    def _fail(self, why: str) -> None:
        self._lost = why
        if self._pending is not None and not self._pending[2].done():
            self._pending[2].set_exception(ConnectionLost(DEVICE, self._pending[1], why))


async def open_arcs(connection: RpcConnection) -> None:
    """Open the connection. Raises `WrongGeneration` if only the older software's port answers."""
    try:
        await connection.open()
    except (ConnectionLost, DeviceTimeout):
        if await answers(connection.host, AUBOPE_PORT):
            raise WrongGeneration(
                DEVICE,
                "connect",
                f"port {connection.port} does not answer but {AUBOPE_PORT} does: this cabinet runs AUBOPE (V4)",
            ) from None
        raise


async def answers(host: str, port: int) -> bool:
    """Whether anything listens there."""
    probe = RpcConnection(host, port)
    try:
        await probe.open()
    except DeviceError:
        return False
    await probe.close()
    return True
