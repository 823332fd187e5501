"""The arm's pose, continuously: pushed by the controller over RTDE, or polled; and how late it arrives.

RTDE begins with a greeting that ends with two newlines, then come SOF frames of CBOR (or JSON).

| who | bytes |
|---|---|
| server, on accept | `{"protocol":"rtde","version":1,"input":{...},"output":{name: id, ...}}` LF LF |
| client, to subscribe | CBOR `[100, {chanel, frequency, segments, to_server, trigger}]` |
| server, from then on | CBOR or JSON `[chanel, value, value, ...]` in the order of the segments |
| client, when idle | `__ping__` NUL, without a frame |

Poses are stamped on arrival, and a controller or a network may hold them back. While the arm moves, the driver also
asks the controller where it is: the lag is the time by which the path of the poses that arrived must be shifted so that
it agrees with the poses that were asked for.
"""

import asyncio
import contextlib
import json
import math
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Sequence
from typing import Any, NoReturn

import cbor2
import numpy as np

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.motion import arrived
from brushloop.drivers.arcs.settings import ArcsTable
from brushloop.drivers.arcs.wire import DEVICE, Decoder, encode_short, in_time, numbers
from brushloop.drivers.devices import Pose, PoseSample, Stamp
from brushloop.drivers.errors import DeviceError, DeviceTimeout, NotConnected, ProtocolViolation, Stale
from brushloop.drivers.geometry import from_wire
from brushloop.drivers.host import Clock, alongside

STREAM = "robot telemetry"
SET_RECIPE = 100
GREETING_END = b"}\n\n"
MAX_GREETING_BYTES = 256 * 1024
MAX_DEPTH = 16


def _refuse(*_: object) -> NoReturn:
    raise ValueError("a tagged value")


def outputs_of(greeting: bytes) -> dict[str, int]:
    """The names that can be subscribed to, with their ids. Raises `ProtocolViolation`."""
    try:
        hello: Any = json.loads(greeting)
    except (ValueError, RecursionError):
        raise ProtocolViolation(STREAM, "greeting", f"not JSON: {greeting[:40]!r}") from None
    match hello:
        case {"protocol": "rtde", "output": dict(outputs)}:  # pyright: ignore[reportUnknownVariableType]
            return {str(name): ident for name, ident in outputs.items() if isinstance(ident, int)}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        case _:
            raise ProtocolViolation(STREAM, "greeting", f"not a greeting of RTDE: {greeting[:40]!r}")


def encode_topic(chanel: int, segments: Sequence[str], frequency_hz: float) -> bytes:
    """Message that subscribes a channel; no segments at frequency 0 end it. The spelling is the maker's."""
    topic = {
        "chanel": chanel,
        "frequency": float(frequency_hz),
        "segments": list(segments),
        "to_server": False,
        "trigger": 0,
    }
    return encode_short(cbor2.dumps([SET_RECIPE, topic]))


def encode_sample(chanel: int, values: Sequence[object]) -> bytes:
    """One push of a channel."""
    return encode_short(cbor2.dumps([chanel, *values]))


def decode_message(payload: bytes) -> tuple[int, list[Any]]:
    """(channel or command, what follows it). Raises `ProtocolViolation`."""
    try:
        if payload.startswith(b"["):
            message: Any = json.loads(payload)
        else:
            # Poses and modes need no tags, and a tagged regular expression of 64 KiB takes half a minute to compile.
            no_tags = defaultdict(lambda: _refuse, {0: _refuse})
            message = cbor2.loads(
                payload, semantic_decoders=no_tags, tag_hook=_refuse, max_depth=MAX_DEPTH, strict_hashable_types=True
            )
    except Exception as error:  # the decoders may raise anything
        raise ProtocolViolation(STREAM, "decode", f"neither CBOR nor JSON: {error}") from None
    match message:
        case [int(head), *rest] if not isinstance(head, bool):
            return head, rest  # pyright: ignore[reportUnknownVariableType]
        case _:
            raise ProtocolViolation(STREAM, "decode", f"not an array that begins with a channel: {payload[:20]!r}")


CHANNEL = 0
SEGMENTS = ("R1_actual_TCP_pose", "R1_actual_q")
RATE_HZ = 100.0
SILENCE_S = 0.5


class RtdeStream:
    """One subscription to pose and joints, on a socket of its own."""

    def __init__(self, host: str, port: int) -> None:
        self.host = host
        self.port = port
        self.offered: dict[str, int] = {}
        """Names in the greeting that can be subscribed to, with their ids."""
        self._decoder = Decoder()
        self._stream: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def open(self) -> None:
        """Connect, read the greeting, subscribe. Raises `ConnectionLost`, `DeviceTimeout`, `ProtocolViolation`."""
        try:
            async with in_time(STREAM, "connect", SILENCE_S, f"greeting from {self.host}:{self.port}"):
                self._stream = await asyncio.open_connection(self.host, self.port, limit=MAX_GREETING_BYTES)
                greeting = await self._stream[0].readuntil(GREETING_END)
        except asyncio.LimitOverrunError:
            raise ProtocolViolation(STREAM, "connect", "a greeting without an end") from None
        self.offered = outputs_of(greeting)
        if missing := set(SEGMENTS) - set(self.offered):
            raise ProtocolViolation(STREAM, "subscribe", f"the controller does not offer {sorted(missing)}")
        self._stream[1].write(encode_topic(CHANNEL, SEGMENTS, RATE_HZ))

    async def samples(self) -> list[list[Any]]:
        """The samples that have piled up, at least one, oldest first; each has a value for each segment.

        Only for the newest is the arrival time known. Raises `DeviceTimeout` after silence, `ConnectionLost`,
        `ProtocolViolation`.
        """
        assert self._stream is not None, "open comes first"
        samples: list[list[Any]] = []
        async with in_time(STREAM, "read", SILENCE_S, "sample"):
            while not samples:
                data = await self._stream[0].read(65536)
                if not data:
                    raise EOFError("the controller closed the connection")
                messages = [decode_message(payload) for payload in self._decoder.feed(data)]
                samples += [values for head, values in messages if head == CHANNEL]
        for values in samples:
            if len(values) != len(SEGMENTS):
                raise ProtocolViolation(STREAM, "read", f"{len(values)} values for {len(SEGMENTS)} segments")
        return samples

    async def close(self) -> None:
        """End the subscription and close the socket."""
        stream, self._stream = self._stream, None
        if stream is not None:
            with contextlib.suppress(OSError):
                stream[1].write(encode_topic(CHANNEL, (), 0.0))
                stream[1].close()
                await stream[1].wait_closed()


QUICK_S = 0.05
"""An answer that took longer, as on a busy computer, does not say well enough when the arm was there."""
MOVED_MM = 0.2
"""The arm moved if it was this far from where it was when it was asked before: at rest, every lag would agree."""
FEWEST, LEAST_MM = 5, 10.0
"""Answers, and the length of the path between them, that it takes to measure the lag."""
GAP_S = 0.1
"""In a longer silence between two poses the path is unknown."""
LONGEST_S, STEP_S = 5.0, 0.01
MISFIT_SHARE = 0.25
"""Largest mean distance between the two paths, as a share of their extent, at which they are the same path."""

Point = tuple[float, float, float, float]
"""Time in s, and the position in mm."""


class LagMeter:
    """The lag of the poses of one arm, over its newest motions."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._arrived: deque[Point] = deque(maxlen=2000)
        self._asked: deque[Point] = deque(maxlen=200)
        self._last_mm = (math.inf,) * 3

    def arrived(self, sample: PoseSample) -> None:
        """Take a pose of the stream."""
        self._arrived.append((sample.stamp.host_ns / 1e9, *sample.pose.position_mm))

    def asked(self, pose: Pose, took_s: float) -> None:
        """Take a pose that was asked for and has just been answered, `took_s` after the question."""
        moved_mm, self._last_mm = math.dist(pose.position_mm, self._last_mm), pose.position_mm
        if MOVED_MM < moved_mm < math.inf and took_s <= QUICK_S:
            self._asked.append((self._clock.now_ns() / 1e9 - 0.5 * took_s, *pose.position_mm))

    def lag_ms(self) -> float | None:
        """The lag; None if the arm has moved too little, or if the two paths cannot be compared."""
        if len(self._arrived) < 2:
            return None
        arrived = np.array(self._arrived)
        t_s, path_mm = arrived[:, 0], arrived[:, 1:]
        asked = np.array([point for point in self._asked if point[0] > t_s[0]]).reshape(-1, 4)
        asked_s, asked_mm = asked[:, 0], asked[:, 1:]
        if len(asked) < FEWEST or np.linalg.norm(np.diff(asked_mm, axis=0), axis=1).sum() < LEAST_MM:
            return None
        lags_s = np.arange(-QUICK_S, LONGEST_S, STEP_S)
        shown_s = lags_s[:, None] + asked_s
        after = np.searchsorted(t_s, shown_s).clip(1, len(t_s) - 1)
        known = (t_s[after] - t_s[after - 1] <= GAP_S) & (shown_s <= t_s[-1])
        shown_mm = np.stack([np.interp(shown_s, t_s, path_mm[:, axis]) for axis in range(3)], axis=-1)
        off_mm = np.linalg.norm(shown_mm - asked_mm, axis=-1)
        enough = known.sum(axis=1) >= max(FEWEST, len(asked) / 2)
        misfit_mm = np.where(enough, (off_mm * known).sum(axis=1) / known.sum(axis=1).clip(1), math.inf)
        best = int(np.argmin(misfit_mm))
        extent_mm = np.linalg.norm(asked_mm - asked_mm.mean(axis=0), axis=1).mean()
        return max(0.0, round(1e3 * float(lags_s[best]), 1)) if misfit_mm[best] <= MISFIT_SHARE * extent_mm else None


STALE_MS = 500.0
MOST_SILENCES = 3
"""Consecutive silences, of half a second each: a busy machine may cause one or two."""
GIVE_UP_S = 2.0


class Telemetry:
    """The newest pose, stamped when it came. RTDE that is closed or silent is never fatal: polling takes over."""

    def __init__(self, state: Controller, table: ArcsTable, clock: Clock, on_notice: Callable[[str], None]) -> None:
        self._state = state
        self._table = table
        self._clock = clock
        self._notice = on_notice
        self._latest: PoseSample | None = None
        self._running = contextlib.AsyncExitStack()
        self._stream: RtdeStream | None = None
        self._seen: list[Pose] | None = None
        self.lag = LagMeter(clock)
        self.listener: Callable[[PoseSample], None] | None = None

    @property
    def source(self) -> str:
        """How poses arrive: `RTDE` or `polling`."""
        return "RTDE" if self._stream is not None else "polling"

    async def start(self) -> None:
        """Read the first pose, then continue until `stop`. Raises what the first read raises."""
        await self.read()
        if self._table.rtde_port is not None:
            self._stream = RtdeStream(self._table.host, self._table.rtde_port)
            try:
                await self._stream.open()
                await self._take_pushed(self._stream)
            except DeviceError as error:
                await self._fall_back(error)
        await self._running.enter_async_context(alongside(self._run(), "robot telemetry"))

    async def stop(self) -> None:
        """End telemetry; the newest pose stays and grows stale."""
        await self._running.aclose()
        await self._drop_stream()

    def latest(self) -> PoseSample:
        """The newest pose. Raises `NotConnected` before the first, `Stale` after `STALE_MS`."""
        if self._latest is None:
            raise NotConnected(DEVICE, "latest", "no pose yet")
        age_ms = (self._clock.now_ns() - self._latest.stamp.host_ns) / 1e6
        if age_ms > STALE_MS:
            raise Stale(DEVICE, age_ms, STALE_MS)
        return self._latest

    @contextlib.contextmanager
    def seeing(self) -> Generator[list[Pose]]:
        """Collect every pose that arrives during the block, including those that arrive too late to be stamped."""
        self._seen = seen = []
        try:
            yield seen
        finally:
            self._seen = None

    async def reaching(self, target: Pose) -> None:
        """Wait until a pose at `target` has arrived, and with it all earlier ones. Gives up after `GIVE_UP_S`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GIVE_UP_S):
                while self._latest is None or not arrived(self._latest.pose, target):
                    await asyncio.sleep(0.5 / RATE_HZ)

    async def read(self) -> None:
        """Ask for the pose once."""
        self._take(await self._state.pose())

    async def _run(self) -> None:
        loop, silences = asyncio.get_running_loop(), 0
        due = loop.time()
        while True:
            if self._stream is None:
                due = max(due + 1.0 / RATE_HZ, loop.time())
                await asyncio.sleep(due - loop.time())
            else:
                try:
                    await self._take_pushed(self._stream)
                    silences = 0
                    continue
                except DeviceError as error:
                    silences += 1
                    if not isinstance(error, DeviceTimeout) or silences > MOST_SILENCES:
                        await self._fall_back(error)
            # A short silence is bridged: the poses that piled up will still arrive. A pose that cannot be read shows as
            # an old sample (`Stale`); the motion path reports the cause.
            with contextlib.suppress(DeviceError):
                await self.read()

    async def _take_pushed(self, stream: RtdeStream) -> None:
        *older, (pose, joints) = await stream.samples()
        if self._seen is not None:
            self._seen += [from_wire(numbers("sample", older_pose)) for older_pose, _ in older]
        self._take(from_wire(numbers("sample", pose)), tuple(numbers("sample", joints)))

    async def _fall_back(self, error: DeviceError) -> None:
        await self._drop_stream()
        self._notice(f"telemetry is polled instead of pushed: {error.what}")

    async def _drop_stream(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            await stream.close()

    def _take(self, pose: Pose, joints_rad: tuple[float, ...] | None = None) -> None:
        seq = self._latest.stamp.seq + 1 if self._latest else 0
        self._latest = PoseSample(Stamp(self._clock.now_ns(), None, seq), pose, joints_rad)
        self.lag.arrived(self._latest)
        if self._seen is not None:
            self._seen.append(pose)
        if self.listener is not None:
            self.listener(self._latest)
