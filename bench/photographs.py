"""`python -m bench.photographs [SEED]`: are photographs fresh, whatever the camera's delay does? (loopback rig)

300 photographs over ten cameras: steady, jittering and drifting delays of .05 to 2.5 s, the rig's or the collecting
process stopped for 2 s at random moments, and 16 busy loops beside. The camera writes the time of each exposure into
its picture, which only this bench reads. Beside it the rule that was there before: the first frame that arrives
250 ms after the arm has parked.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness import machine, percentile
from bench.processes import ROOT, lines_of_input, started, tell
from brushloop.collect.errors import StepError
from brushloop.collect.motion.moves import press_moves
from brushloop.collect.motion.procedures import Procedures
from brushloop.collect.photograph import frames as frames_of
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import connected
from brushloop.collect.rig.paper import Sheet
from brushloop.drivers.camera.opencv import OpenCvCamera
from brushloop.drivers.clock import HostClock
from brushloop.drivers.errors import DeviceError
from brushloop.drivers.samples import Frame, Stamp
from brushloop.drivers.sim.camera.scene import STRIP_PX, read_strip
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.sessions.records import Condition

EACH = 30
VIEW = View(width_px=1024, height_px=768, px_per_mm=3.12, fps=20.0, stamp_strip=True)
RATE = 20.0
OLD_RULE_S = 0.25
STOP_S = 2.0
LIMITS = {"max_delay_ms": 1500.0, "max_jitter_ms": 500.0}
"""The defaults of a real camera; the loopback rig writes wider ones."""
MOST_REFUSALS = 3
"""A run would have ended with the first."""


@dataclass(frozen=True, slots=True)
class Case:
    """One camera, and what else goes on."""

    name: str
    view: View
    stops: str = ""
    """Which process is stopped now and then: rig or collect."""
    loops: int = 0


def cases() -> list[Case]:
    """What is measured."""
    late = [Case(f"steady {s:g} s", replace(VIEW, delay_s=s)) for s in (0.05, 0.3, 1.0, 2.5)]
    return [
        *late,
        Case("jittering .1 to .6 s", replace(VIEW, delay_s=0.1, delay_jitter_s=0.5)),
        Case("jittering .3 to 2.5 s", replace(VIEW, delay_s=0.3, delay_jitter_s=2.2)),
        Case("drifting from .1 s by 20 ms a second", replace(VIEW, delay_s=0.1, delay_drift=0.02)),
        Case("rig stopped for 2 s", replace(VIEW, delay_s=0.1), stops="rig"),
        Case("collect stopped for 2 s", replace(VIEW, delay_s=0.1), stops="collect"),
        Case("16 busy loops", replace(VIEW, delay_s=0.1), loops=16),
    ]


async def serve(path: Path, view: View) -> None:
    """The rig of one case, in a process of its own, until its input ends."""
    async with LoopbackRig(SimConfig(rate=RATE, force_sensor=False, ink_device="none", view=view)) as rig:
        text = rig.toml()
        for name, value in LIMITS.items():
            text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
        path.write_text(text, encoding="utf-8")
        asked = await lines_of_input()
        tell("ready")
        await asked.read()


async def photograph(path: Path, seed: int) -> None:
    """Presses and photographs, a line of JSON for each; in a process of its own."""
    config = RigConfig(**tomllib.loads(path.read_text(encoding="utf-8")))
    cells, rng = Sheet(config.paper), random.Random(seed)
    seen: list[tuple[float, float]] = []
    _blind_to_the_strip(seen)
    async with connected(config, HostClock(), lambda _text: None) as rig:
        await rig.robot.enable()
        procedures = Procedures(rig)
        await procedures.retreat()
        refused = 0
        for _ in range(EACH):
            if refused == MOST_REFUSALS:
                break
            try:
                if procedures.photographer.delay is not None:
                    cell = cells.patch(rng.randrange(cells.capacity))
                    down, up = press_moves(config, procedures.plane, cell, Condition(rng.uniform(11.0, 20.0), 0.0))
                    for move in [*down, *up]:
                        await procedures.go(move)
                left_s = time.time()
                began = time.perf_counter()
                frame = await procedures.capture()
                tell(json.dumps(_row(frame, left_s, time.perf_counter() - began, seen, procedures)))
            except (StepError, DeviceError) as error:
                refused += isinstance(error, StepError)  # not where the rig did not answer while it was stopped
                tell(json.dumps({"error": type(error).__name__, "what": str(error), "true_s": _true_s(seen)}))
                procedures.photographer.forget()
                with contextlib.suppress(DeviceError):
                    await procedures.retreat()
            seen.clear()


def _row(frame: Frame, left_s: float, took_s: float, seen: list[tuple[float, float]], at: Procedures) -> dict[str, Any]:
    delay, parked_s = at.photographer.delay, frame.exposed_after_ns / 1e9
    old = next((exposed for arrival, exposed in seen if arrival - OLD_RULE_S >= parked_s), None)
    return {
        "fresh": read_strip(frame.image) / 1e9 >= parked_s - 0.005,  # the clocks of two processes
        "old_fresh": None if old is None else old >= parked_s - 0.005,
        "measured_s": None if delay is None else delay.delay_s,  # None: to be measured again
        "first": took_s,
        "true_s": _true_s(seen),
    }


def _true_s(seen: list[tuple[float, float]]) -> float | None:
    return float(np.median([arrival - exposed for arrival, exposed in seen])) if seen else None


def _blind_to_the_strip(seen: list[tuple[float, float]]) -> None:
    """Note the truth about every frame, and hide the strip that holds it from those who look at the picture."""
    whole, fresh = frames_of.thumbnail, OpenCvCamera.fresh

    async def noted(self: OpenCvCamera, after: Stamp) -> Frame:
        frame = await fresh(self, after)
        seen.append((frame.stamp.host_ns / 1e9, read_strip(frame.image) / 1e9))
        return frame

    OpenCvCamera.fresh = noted
    frames_of.thumbnail = lambda image: whole(image[3 * STRIP_PX :])


def measure(number: int, case: Case, seed: int) -> str:
    """One line of the table."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, busy(case.loops):
        path = Path(folder) / "rig.toml"
        with started("bench.photographs", "rig", str(path), str(number)) as rig:
            command = [sys.executable, "-m", "bench.photographs", "photograph", str(path), str(seed)]
            with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as collect:
                assert collect.stdout is not None
                pid = {"rig": rig.pid, "collect": collect.pid}.get(case.stops)
                for line in collect.stdout:
                    rows.append(json.loads(line))
                    if pid is not None and len(rows) % 3 == 0:
                        time.sleep(random.Random(seed + len(rows)).random())
                        stop(pid)
    return _line(case, rows)


def stop(pid: int) -> None:
    """Stop a process for `STOP_S`, as a loaded host does."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(STOP_S)
        os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """This many loops beside, until the block ends."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def _line(case: Case, rows: list[dict[str, Any]]) -> str:
    taken = [row for row in rows if "fresh" in row]
    stale = sum(not row["fresh"] for row in taken)
    old = [row["old_fresh"] for row in taken if row["old_fresh"] is not None]
    refused = [row["error"] for row in rows if "error" in row]
    delays = ""
    if taken:
        measured_s, true_s = taken[0]["measured_s"], taken[0]["true_s"]
        delays = f"{1e3 * measured_s:.0f} / {1e3 * true_s:.0f}"
    took = f"{percentile([row['first'] for row in taken], 50):.2f}" if taken else ""
    errors = ", ".join(f"{refused.count(name)} {name}" for name in sorted(set(refused))) or "none"
    return f"| {case.name} | {len(taken)} | {stale} | {old.count(False)} of {len(old)} | {delays} | {took} | {errors} |"


def main(seed: int) -> None:
    """Measure and print the table."""
    tell(f"Photographs on the loopback rig, seed {seed}, {machine()}")
    tell("| camera | photographs | stale | stale by the old rule | measured / true delay, ms | s each | refused |")
    tell("|---|---|---|---|---|---|---|")
    for number, case in enumerate(cases()):
        tell(measure(number, case, seed))


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["rig", path, number]:
            asyncio.run(serve(Path(path), cases()[int(number)].view))
        case ["photograph", path, seed]:
            asyncio.run(photograph(Path(path), int(seed)))
        case [] | [_]:
            main(int(sys.argv[1]) if sys.argv[1:] else 0)
        case other:
            sys.exit(f"unknown arguments {other}")
