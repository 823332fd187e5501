"""How evenly poses come: pushed over RTDE beside polled for, both asked for at 100 Hz."""

from __future__ import annotations

import asyncio
import itertools

from bench.harness import Result, percentile
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import make_robot
from brushloop.drivers.clock import HostClock
from brushloop.drivers.samples import PoseSample

PERIOD_MS = 10.0
TURNS = 4


async def measure(rig: RigConfig, n: int, seed: int, conditions: str) -> list[Result]:
    """|interval - 10 ms| of `n` intervals each, in turns; missed is how many samples fewer than one each 10 ms came."""
    polled = rig.model_copy(update={"robot": rig.robot.model_copy(update={"rtde_port": None})})
    intervals_ms: dict[str, list[float]] = {"RTDE": [], "polling": []}
    missed = {"RTDE": 0, "polling": 0}
    for turn in range(TURNS):
        share = n * (turn + 1) // TURNS - n * turn // TURNS
        for name, config in (("RTDE", rig), ("polling", polled)):
            if share:
                taken_ms = await _intervals_ms(config, share)
                intervals_ms[name] += taken_ms
                missed[name] += max(0, round(sum(taken_ms) / PERIOD_MS) - share)
    off_ms = {name: [abs(ms - PERIOD_MS) for ms in taken] for name, taken in intervals_ms.items()}
    results: list[Result] = []
    for ours, peer in (("RTDE", "polling"), ("polling", "RTDE")):
        for what, percent in (("p50", 50.0), ("p99", 99.0), ("max", 100.0)):
            ours_ms, peer_ms = percentile(off_ms[ours], percent), percentile(off_ms[peer], percent)
            name = f"telemetry {ours} jitter {what}"
            results.append(
                Result(name, ours_ms, "ms", f"the same {_how(peer)}", peer_ms / ours_ms, n, seed, conditions)
            )
        # One more on both sides: a ratio must not divide by zero, and equal counts are 1.
        ratio, baseline = (missed[peer] + 1) / (missed[ours] + 1), f"the same {_how(peer)}, each plus one"
        results.append(
            Result(f"telemetry {ours} missed", missed[ours], "samples", baseline, ratio, n, seed, conditions)
        )
    return results


async def _intervals_ms(rig: RigConfig, count: int) -> list[float]:
    """Between the host's stamps of neighbouring samples."""
    arrivals_ns: list[int] = []
    enough = asyncio.Event()

    def take(sample: PoseSample) -> None:
        arrivals_ns.append(sample.stamp.host_ns)
        if len(arrivals_ns) > count:
            enough.set()

    robot = make_robot(rig, HostClock(), lambda _text: None)
    await robot.connect()
    try:
        robot.listen(take)
        await enough.wait()
    finally:
        robot.listen(None)
        await robot.close()
    return [(b - a) / 1e6 for a, b in itertools.pairwise(arrivals_ns[: count + 1])]


def _how(source: str) -> str:
    return "polled for" if source == "polling" else "pushed over RTDE"
