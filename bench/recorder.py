"""The recorder under a rig's load: poses at 100 Hz, forces at 1 kHz, a photograph now and then.

Two questions. How fast can it write, beside foxglove-sdk? And how much does it take from the
program that records: CPU, and the longest time that one `write` holds up the caller?
"""

from __future__ import annotations

import gc
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from statistics import median

import numpy as np
from mcap_protobuf.schema import build_file_descriptor_set

from bench.harness import BenchError, Result, rounds_of
from brushloop.sessions.mcap_writer import Outgoing, SegmentWriter, encoded
from brushloop.sessions.messages import encode_png, image_message, pose_message
from brushloop.sessions.records import Event, Header, Source, Topic, Wrench

POSE_HZ, FORCE_HZ, STILL_HZ = 100, 1000, 0.5
LOAD_S = 10.0
"""How much of a recording is written as fast as possible in one round."""
FLAT_RUNS = 5
"""Times that each writes it in one round: they are short, and a busy machine delays some."""
PACED_S = 4.0
"""How long the load runs at its real pace in one round."""

Write = Callable[[Outgoing], None]
Contestant = Callable[[Path], AbstractContextManager[Write]]


def run(*, n: int | None = None, seed: int = 0) -> list[Result]:
    """Write rate, and CPU and worst hold-up at the real pace, beside foxglove-sdk; rounds take turns.

    Raises BenchError without foxglove-sdk (`pip install foxglove-sdk`), ValueError for n < 1.
    """
    rounds = rounds_of(n, 3)
    load = list(_load(seed, LOAD_S))
    megabytes = sum(len(encoded(outgoing.message)) for outgoing in load) / 1e6
    paced = list(_load(seed, PACED_S))
    contestants = (_ours, _foxglove)
    rates: dict[str, list[float]] = {c.__name__: [] for c in contestants}
    shares: dict[str, list[float]] = {c.__name__: [] for c in contestants}
    worst: dict[str, list[float]] = {c.__name__: [] for c in contestants}
    with tempfile.TemporaryDirectory() as scratch:
        for _ in range(rounds):
            for contestant in contestants * FLAT_RUNS:
                rates[contestant.__name__].append(megabytes / _flat_out(contestant, Path(scratch), load))
            for contestant in contestants:
                share, held_ms = _at_pace(contestant, Path(scratch), paced)
                shares[contestant.__name__].append(share)
                worst[contestant.__name__].append(held_ms)
    ours, foxglove = (median(rates[c.__name__]) for c in contestants)
    cpu, cpu_foxglove = (median(shares[c.__name__]) for c in contestants)
    held, held_foxglove = (max(worst[c.__name__]) for c in contestants)
    still_mb = len(encoded(paced[0].message)) / 1e6
    conditions = (
        f"{POSE_HZ} Hz poses, {FORCE_HZ} Hz forces as JSON, a {still_mb:.1f} MB still "
        f"each {1 / STILL_HZ:g} s; fsync at the end; CPU includes the pacing; {os.cpu_count()} cores"
    )

    def result(name: str, value: float, unit: str, peer: str, ratio: float) -> Result:
        return Result(f"recorder {name}", value, unit, peer, ratio, rounds, seed, conditions)

    return [
        result("write rate", ours, "MB/s", f"foxglove-sdk ({foxglove:.0f} MB/s)", ours / foxglove),
        result("CPU", 100 * cpu, "% of one core", f"foxglove-sdk ({100 * cpu_foxglove:.1f} %)", cpu_foxglove / cpu),
        result("worst hold-up", held, "ms", f"foxglove-sdk ({held_foxglove:.2f} ms)", held_foxglove / held),
    ]


def _load(seed: int, seconds: float) -> Iterator[Outgoing]:
    """The messages of this many seconds, in order of time, starting with a still."""
    random = np.random.default_rng(seed)
    paper = np.clip(random.normal(225, 6, (1536, 2048)), 0, 255).astype(np.uint8)
    png = encode_png(paper)
    for tick in range(int(seconds * FORCE_HZ)):
        t_ns = tick * 1_000_000_000 // FORCE_HZ
        if tick % int(FORCE_HZ / STILL_HZ) == 0:
            yield Outgoing(Topic.STILL, t_ns, t_ns, tick, image_message(t_ns, png))
        if tick % (FORCE_HZ // POSE_HZ) == 0:
            x, y, z = random.normal(0, 100, 3)
            yield Outgoing(Topic.TCP, t_ns, t_ns, tick, pose_message(t_ns, (x, y, z), (0.0, 0.0, 0.0, 1.0)))
        fx, fy, fz, mx, my, mz = random.normal(0, 1, 6)
        yield Outgoing(Topic.WRENCH, t_ns, t_ns, tick, Wrench(fx_n=fx, fy_n=fy, fz_n=fz, mx_nm=mx, my_nm=my, mz_nm=mz))


def _flat_out(contestant: Contestant, folder: Path, load: list[Outgoing]) -> float:
    """Seconds from the first write until all is on disk."""
    gc.collect()
    place = folder / "flat"
    place.mkdir()
    start = time.perf_counter()
    with contestant(place) as write:
        for outgoing in load:
            write(outgoing)
    took = time.perf_counter() - start
    shutil.rmtree(place)
    return took


def _at_pace(contestant: Contestant, folder: Path, load: list[Outgoing]) -> tuple[float, float]:
    """(share of one core that the process uses, longest time in ms that one write takes)."""
    gc.collect()
    place = folder / "paced"
    place.mkdir()
    held = 0.0
    cpu, start = time.process_time(), time.perf_counter()
    with contestant(place) as write:
        for outgoing in load:
            ahead = start + outgoing.log_ns / 1e9 - time.perf_counter()
            if ahead > 0:
                time.sleep(ahead)
            before = time.perf_counter()
            write(outgoing)
            held = max(held, time.perf_counter() - before)
    share = (time.process_time() - cpu) / (time.perf_counter() - start)
    shutil.rmtree(place)
    return share, held * 1e3


@contextmanager
def _ours(folder: Path) -> Iterator[Write]:
    header = Header(session_id="bench", source=Source.LOOPBACK, software="bench")
    writer = SegmentWriter(folder / "ours.mcap", header)
    try:
        yield writer.write
    except BaseException:
        writer.abandon()
        raise
    writer.finish()


@contextmanager
def _foxglove(folder: Path) -> Iterator[Write]:
    try:
        import foxglove
    except ImportError:
        raise BenchError("foxglove-sdk is missing: pip install foxglove-sdk") from None

    context = foxglove.Context()
    channels: dict[str, foxglove.Channel] = {}

    def write(outgoing: Outgoing) -> None:
        channel = channels.get(outgoing.topic)
        if channel is None:
            channel = channels[outgoing.topic] = _foxglove_channel(foxglove, outgoing, context)
        channel.log(encoded(outgoing.message), log_time=outgoing.log_ns)

    path = folder / "foxglove.mcap"
    with foxglove.open_mcap(path, context=context):
        yield write
    _sync(path)


def _foxglove_channel(foxglove, outgoing: Outgoing, context):  # type: ignore[no-untyped-def]
    message = outgoing.message
    if isinstance(message, Event):
        schema = type(message).model_json_schema()
        return foxglove.Channel(str(outgoing.topic), schema=schema, message_encoding="json", context=context)
    described = build_file_descriptor_set(type(message)).SerializeToString()
    schema = foxglove.Schema(name=message.DESCRIPTOR.full_name, encoding="protobuf", data=described)
    return foxglove.Channel(str(outgoing.topic), schema=schema, message_encoding="protobuf", context=context)


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
