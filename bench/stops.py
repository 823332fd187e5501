"""How soon a stop is on the wire while the arm moves and the call that set it going gets no answer.

From `robot.stop()` to the moment when the socket on the controller's side has the frame; a proxy in a process of its
own stands there and holds the answer back. In turns with the same frame written bare to an idle socket.
"""

from __future__ import annotations

import asyncio
import random
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from bench.harness import BenchError, Result, percentile
from bench.processes import HOST, ROOT
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import make_robot
from brushloop.drivers.arcs.framing import encode
from brushloop.drivers.arcs.rpc import encode_request, request_id
from brushloop.drivers.clock import HostClock
from brushloop.drivers.geometry import brush_pose

SPEED_MM_S, ACC_MM_S2 = 20.0, 800.0
LATEST_KEY_S = 0.02
"""The key comes within so long after the line went out."""
WITHIN_S = 5.0


class Wire:
    """What the proxy sees."""

    def __init__(self, process: asyncio.subprocess.Process, port: int) -> None:
        self._process = process
        self.port = port

    async def sees(self, name: str) -> int:
        """When the next frame with that name came, by the monotonic clock in ns. Raises BenchError for silence."""
        assert self._process.stdout is not None
        try:
            async with asyncio.timeout(WITHIN_S):
                while line := await self._process.stdout.readline():
                    what, at_ns = line.split()
                    if what.decode() == name:
                        return int(at_ns)
        except TimeoutError:
            pass
        raise BenchError(f"the proxy saw no {name} within {WITHIN_S:g} s")

    async def release(self) -> None:
        """Let the answer through, and forget what was seen until now."""
        assert self._process.stdin is not None
        self._process.stdin.write(b"\n")
        await self.sees("released")


@asynccontextmanager
async def wire_to(port: int) -> AsyncIterator[Wire]:
    """A proxy in front of the controller."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "bench.proxy",
        str(port),
        cwd=ROOT,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        yield Wire(process, int(await process.stdout.readline()))
    finally:
        process.stdin.close()
        await process.wait()


async def measure(rig: RigConfig, n: int, seed: int, conditions: str) -> list[Result]:
    """p50 and p99 of `n` stops of a moving arm, each with its moveLine unanswered."""
    rng = random.Random(seed)
    x, y, z = rig.motion.park_mm
    targets = [brush_pose(x, y + 60.0, z), brush_pose(x, y, z)]
    ours_ms: list[float] = []
    bare_ms: list[float] = []
    async with wire_to(rig.robot.port) as wire:
        through = rig.model_copy(update={"robot": rig.robot.model_copy(update={"port": wire.port})})
        robot = make_robot(through, HostClock(), lambda _text: None)
        try:
            await robot.connect()
            await robot.enable()
            reader, writer = await asyncio.open_connection(HOST, wire.port)
            for turn in range(n):
                target = targets[turn % 2]
                move = asyncio.create_task(robot.move(target, speed_mm_s=SPEED_MM_S, acc_mm_s2=ACC_MM_S2))
                await wire.sees("moveLine")
                await asyncio.sleep(rng.uniform(0.0, LATEST_KEY_S))
                pressed_ns = time.monotonic_ns()
                stop = asyncio.create_task(robot.stop())
                ours_ms.append((await wire.sees("stopLine") - pressed_ns) / 1e6)
                if move.done():
                    raise BenchError("the call that was to stay unanswered ended")
                await wire.release()
                await stop  # it ends when the line that it has overtaken is answered
                move.cancel()
                await asyncio.gather(move, return_exceptions=True)
                await wire.release()

                pressed_ns = time.monotonic_ns()
                writer.write(_stop_frame())
                bare_ms.append((await wire.sees("stopLine") - pressed_ns) / 1e6)
                await reader.read(65536)
            writer.close()
            await writer.wait_closed()
        finally:
            await robot.close()
    peer = "the same frame written bare to an idle socket"
    conditions = (
        f"from robot.stop() to the frame at the controller's socket, arm moving, its moveLine unanswered; {conditions}"
    )
    results: list[Result] = []
    for what, percent in (("p50", 50.0), ("p99", 99.0), ("max", 100.0)):
        value_ms, peer_ms = percentile(ours_ms, percent), percentile(bare_ms, percent)
        results.append(Result(f"stop latency {what}", value_ms, "ms", peer, peer_ms / value_ms, n, seed, conditions))
    return results


def _stop_frame() -> bytes:
    return encode(encode_request(request_id(), "rob1.MotionControl.stopLine", {"acc": 2.0, "acc_rot": 2.0}))
