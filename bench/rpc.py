"""What the wire costs, against the loopback controller in a process of its own: `python -m bench rpc`.

Round trips in both framings, telemetry pushed and polled, stops beside a call that gets no answer, whole presses.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

from bench import cadence, presses, stops
from bench.harness import Result, machine, percentile
from bench.processes import HOST, started
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.drivers.arcs.framing import encode
from brushloop.drivers.arcs.rpc import Framing, RpcConnection, encode_request, request_id

BLOCK = 50
"""Calls of one kind before it is another kind's turn."""
METHOD = "rob1.RobotState.getTcpPose"
RATE_OF_PRESSES = 1000.0
"""As fast as `brushloop sim` goes."""

Call = Callable[[], Awaitable[object]]


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """All of it: `n` calls, intervals, stops and presses each, or as many as each part finds enough.

    Where time is the unit, ratio = the peer's over ours; where it is a rate, ours over the peer's. Raises BenchError
    where a helper process ends early, ValueError for n < 1.
    """
    if n is not None and n < 1:
        raise ValueError(f"n = {n}: at least one round is needed")
    conditions = f"loopback rig on {HOST}, controller in its own process, {machine()}"
    results: list[Result] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        with started("bench.processes", "controller", str(path), "1"):
            rig = load_rig(path)
            with started("bench.processes", "echo") as echo:
                results += asyncio.run(round_trips(rig, int(echo.first), n or 5000, seed, conditions))
            results += asyncio.run(cadence.measure(rig, n or 1000, seed, conditions))
            results += asyncio.run(stops.measure(rig, n or 300, seed, conditions))
        with started("bench.processes", "controller", str(path), str(RATE_OF_PRESSES)) as controller:
            results += asyncio.run(
                presses.measure(load_rig(path), controller, RATE_OF_PRESSES, n or 60, seed, conditions)
            )
    return results


async def round_trips(rig: RigConfig, echo_port: int, n: int, seed: int, conditions: str) -> list[Result]:
    """Calls one after the other on one connection, in both framings, beside an echo of as many bytes."""
    connections = {framing: RpcConnection(rig.robot.host, rig.robot.port, framing=framing) for framing in _framings()}
    request = encode(encode_request(request_id(), METHOD, None))
    reader, writer = await asyncio.open_connection(HOST, echo_port)

    async def echo() -> None:
        writer.write(request)
        await reader.readexactly(len(request))

    async def ask(connection: RpcConnection) -> None:
        await connection.call(METHOD)

    try:
        for connection in connections.values():
            await connection.open()
            await connection.login()
        calls: dict[str, Call] = {"echo": echo}
        calls |= {name: lambda connection=connection: ask(connection) for name, connection in connections.items()}
        took_s = await _in_turns(calls, n)
    finally:
        writer.close()
        await writer.wait_closed()
        for connection in connections.values():
            await connection.close()
    results: list[Result] = []
    peer_s, peer = took_s["echo"], f"a bare asyncio echo of {len(request)} bytes"
    conditions = f"{METHOD}, one call at a time; {conditions}"
    for name in connections:
        ours_s = took_s[name]
        ours_hz, peer_hz = len(ours_s) / sum(ours_s), len(peer_s) / sum(peer_s)
        results.append(Result(f"rpc {name}", ours_hz, "round trips/s", peer, ours_hz / peer_hz, n, seed, conditions))
        for percent in (50, 99):
            ours_ms, peer_ms = (1e3 * percentile(s, percent) for s in (ours_s, peer_s))
            results.append(
                Result(f"rpc {name} p{percent}", ours_ms, "ms", peer, peer_ms / ours_ms, n, seed, conditions)
            )
    return results


def _framings() -> tuple[Framing, ...]:
    return "sof", "bare"


async def _in_turns(calls: dict[str, Call], n: int) -> dict[str, list[float]]:
    """Seconds of each of `n` calls of every kind, called in turns, after one unmeasured block of each."""
    clock = asyncio.get_running_loop().time
    took_s: dict[str, list[float]] = {name: [] for name in calls}
    measured = False
    while not measured or len(took_s["echo"]) < n:
        block = min(BLOCK, n - len(took_s["echo"])) if measured else BLOCK
        for name, call in calls.items():
            for _ in range(block):
                began_s = clock()
                await call()
                if measured:
                    took_s[name].append(clock() - began_s)
        measured = True
    return took_s
