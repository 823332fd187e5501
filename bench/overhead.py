"""How much the software adds to the arm's own motion: a session at the rig's real speed, taken apart.

The controller, in a process of its own, tells when the arm really moved. What else a stroke takes is waiting for a
device (the controller calls the arm steady some time after it has come to rest, the camera has an exposure to make) or
the software's, less the dwell that the protocol asks for.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

from bench.harness import BenchError, Result, machine
from bench.processes import Process, lines_of_input, started, tell

HEIGHTS_MM = [11.0, 13.0, 15.0, 17.0, 20.0]
DWELL_S = 0.2
GOAL_PERCENT = 2.0
SILENCE = "stale_ms = 100.0\n"
STEADY, FRAME, INK = "the controller calls the arm steady", "a fresh frame", "the ink station"
WAITS = (STEADY, FRAME, INK)
ENCODE, JUDGE, FILES, MERGE = "encode the still", "judge the capture", "journal and files", "merge and verify"
BLANK = "check that the sheet is blank"
"""Once a sheet, which holds dozens of strokes: reported apart from what each stroke takes."""
BEFORE, SETTLING, REST = "from a move to its motion", "from steady to the move's end", "the rest"
PARTS = ("motion", ENCODE, JUDGE, BLANK, FILES, FRAME, INK, STEADY, BEFORE, SETTLING)
"""The first that covers an instant has it."""
LEAST_MS = 1.0
"""A part that takes less is no figure: the spans are noted to about a millisecond."""
Span = tuple[float, float]
"""Begin and end in seconds on the monotonic clock."""
Spans = dict[str, list[Span]]


@dataclass
class Watch:
    """What was noted."""

    spans: Spans = field(default_factory=lambda: defaultdict(list))
    cpu_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """CPU time by part, where one thread does it."""


def run(*, n: int | None = None, seed: int = 0) -> list[Result]:
    """Software time of `n` strokes (4) as a share of the arm's motion, in all and by what it is.

    CPU time is that of the thread that does the part; OpenCV's own threads are not in it.

    Takes about half a minute a stroke. Raises BenchError where the session fails, ValueError for n < 1.
    """
    strokes = 4 if n is None else n
    if strokes < 1:
        raise ValueError(f"n = {strokes}: at least one stroke is needed")
    watch = Watch()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        with started("bench.overhead", "controller", str(folder / "rig.toml"), str(seed)) as controller:
            _write_protocol(folder / "protocol.toml", strokes, seed)
            with _watching(watch):
                _collect(folder)
            watch.spans["motion"] = _motion(controller)
    return _results(watch, strokes, seed)


def _results(watch: Watch, strokes: int, seed: int) -> list[Result]:
    spans = watch.spans
    begin_s = min(begin for begin, _ in spans["dip"])
    end_s = max(end for _, end in spans["capture"])
    took = share_out(spans, begin_s, end_s)
    motion_s = took.pop("motion") / strokes
    took[REST] = max(took[REST] - DWELL_S * strokes, 0.0)  # some of the dwell lies within other parts
    [(merge_begin_s, merge_end_s)] = spans["merge"]
    took[MERGE] = merge_end_s - merge_begin_s
    once_s = took.pop(BLANK)
    waits_s = sum(took[part] for part in WAITS) / strokes
    all_s = sum(took.values()) / strokes
    conditions = f"loopback rig at its real speed, {motion_s:.1f} s of motion a stroke, dwell left out; {machine()}"

    def result(name: str, value: float, unit: str, peer: str, ratio: float) -> Result:
        return Result(f"overhead: {name}", value, unit, peer, ratio, strokes, seed, conditions)

    results: list[Result] = []
    for name, seconds in (("software", all_s - waits_s), ("software and waits for devices", all_s)):
        percent = 100.0 * seconds / motion_s
        results.append(result(name, percent, "% of motion", f"the goal ({GOAL_PERCENT:g} %)", GOAL_PERCENT / percent))
    for name, seconds in sorted(took.items(), key=lambda item: -item[1]):
        each_ms = 1e3 * seconds / strokes
        if each_ms < LEAST_MS:
            continue
        unit = "ms a stroke, waited" if name in WAITS else "ms a stroke"
        if name in watch.cpu_s:
            unit = f"ms a stroke ({1e3 * watch.cpu_s[name] / strokes:.0f} ms of CPU)"
        results.append(result(name, each_ms, unit, "the motion", 1e3 * motion_s / each_ms))
    if 1e3 * once_s >= LEAST_MS:
        results.append(result(BLANK, 1e3 * once_s, "ms a sheet", "the motion of one stroke", motion_s / once_s))
    return results


def share_out(spans: Spans, begin_s: float, end_s: float) -> dict[str, float]:
    """Seconds of [begin, end] by part; an instant that no part covers is `the rest`."""
    from brushloop.drivers.sim.arm.motion import STEADY_LAG_S

    moves = [_around(move, spans["motion"]) for move in spans["move"]]
    parts = dict(spans) | {
        BEFORE: [before for before, _ in moves],
        STEADY: [(rest_s, min(rest_s + STEADY_LAG_S, end_s)) for _, (rest_s, end_s) in moves],
        SETTLING: [after for _, after in moves],
    }
    marks = {begin_s, end_s}
    marks |= {t for part in PARTS for span in parts.get(part, ()) for t in span if begin_s < t < end_s}
    edges = sorted(marks)
    took: dict[str, float] = dict.fromkeys((*PARTS, REST), 0.0)
    for begin, end in itertools.pairwise(edges):
        middle = (begin + end) / 2.0
        covering = (part for part in PARTS if any(a <= middle <= b for a, b in parts.get(part, ())))
        took[next(covering, REST)] += end - begin
    return took


def _around(move: Span, motion: list[Span]) -> tuple[Span, Span]:
    """What lies before and after the motion within one move; all of it before, where nothing had to move."""
    inside = [(a, b) for a, b in motion if b > move[0] and a < move[1]]
    if not inside:
        return (move[0], move[1]), (move[1], move[1])
    return (move[0], min(a for a, _ in inside)), (max(b for _, b in inside), move[1])


def _collect(folder: Path) -> None:
    from brushloop.collect.engine.engine import Engine
    from brushloop.collect.engine.open_or_resume import Opening, find_resumable, open_store
    from brushloop.drivers.clock import HostClock

    opening = Opening.load(folder / "sessions", folder / "rig.toml", folder / "protocol.toml")
    resume, clock = find_resumable(opening), HostClock()
    engine = Engine(opening.rig, opening.protocol, lambda rig: open_store(opening, resume, rig, clock), clock)
    engine.start()
    try:
        engine.join()
    except Exception as error:
        raise BenchError(f"the session failed: {error}") from error
    if engine.snapshot().voids:
        raise BenchError("a step was cut; the figures would cover two attempts")


@contextlib.contextmanager
def _watching(watch: Watch) -> Iterator[None]:
    """Note when each part begins and ends."""
    from brushloop.collect.engine.perform import Performer
    from brushloop.collect.engine.recorder import Recorder
    from brushloop.collect.engine.steps import capture as capturing
    from brushloop.collect.engine.steps import dip as dipping
    from brushloop.drivers.arcs.robot import AuboArcs
    from brushloop.drivers.camera import OpenCvCamera
    from brushloop.sessions.store import SessionStore

    def noted(function: Callable[..., Any], part: str | None) -> Callable[..., Any]:
        async def later(*arguments: Any, **options: Any) -> Any:
            begin_s = time.monotonic()
            try:
                return await function(*arguments, **options)
            finally:
                watch.spans[part or str(arguments[1].kind)].append((begin_s, time.monotonic()))

        def at_once(*arguments: Any, **options: Any) -> Any:
            begin_s, cpu_s = time.monotonic(), time.thread_time()
            try:
                return function(*arguments, **options)
            finally:
                assert part is not None
                watch.spans[part].append((begin_s, time.monotonic()))
                watch.cpu_s[part] += time.thread_time() - cpu_s

        return later if asyncio.iscoroutinefunction(function) else at_once

    watched: list[tuple[Any, str, str | None]] = [
        (Performer, "perform", None),  # by the kind of its step
        (AuboArcs, "move", "move"),
        (OpenCvCamera, "fresh", FRAME),
        (dipping, "fill_well", INK),
        (Recorder, "still", ENCODE),
        (capturing, "_judge", JUDGE),
        (capturing, "_inked_patches", BLANK),
        (SessionStore, "begin", FILES),
        (SessionStore, "done", FILES),
        (SessionStore, "close", "merge"),
    ]
    with contextlib.ExitStack() as stack:
        for owner, name, part in watched:
            stack.enter_context(mock.patch.object(owner, name, noted(getattr(owner, name), part)))
        yield


def _write_protocol(path: Path, strokes: int, seed: int) -> None:
    heights = HEIGHTS_MM[:strokes]
    repeats = -(-strokes // len(heights))
    if repeats * len(heights) != strokes:
        raise ValueError(f"n = {strokes}: up to {len(HEIGHTS_MM)}, or a multiple of it")
    text = f'kind = "grid"\ndepths_mm = {heights}\ntilts_deg = [5.0]\nrepeats = {repeats}\n'
    path.write_text(f"{text}dwell_s = {DWELL_S}\nseed = {seed}\n", encoding="utf-8")


def _motion(controller: Process) -> list[Span]:
    return [(begin_s, end_s) for begin_s, end_s in json.loads(controller.ask())]


async def _controller(path: Path, seed: int) -> None:
    """Serves the rig; each line on the input is answered with the spans of time in which the arm moved."""
    from brushloop.collect.rig.config_devices import MOST_STALE_LOOPBACK_MS
    from brushloop.drivers.sim.config import SimConfig
    from brushloop.drivers.sim.rig import LoopbackRig

    spans: list[Span] = []
    async with LoopbackRig(SimConfig(seed=seed + 1)) as rig:
        queue, clock = rig.world.motion, rig.world.clock
        finish = queue._finish  # pyright: ignore[reportPrivateUsage]

        def finished(segment: Any) -> None:
            # At rate 1 the rig's clock and the monotonic one, which all processes share, differ by a constant.
            shift_s = time.monotonic() - clock.now_s()
            spans.append((segment.begin_s + shift_s, segment.end_s + shift_s))
            finish(segment)

        queue._finish = finished  # pyright: ignore[reportPrivateUsage]
        # The rig and what collects share the cores with whatever else runs here, and a sensor's thread that has to wait
        # for one falls silent. No brush is in danger: the longest silence that the loopback bus may have is allowed.
        text = rig.toml()
        assert SILENCE in text, "the rig does not limit the silence of its force sensor as expected"
        path.write_text(text.replace(SILENCE, f"stale_ms = {MOST_STALE_LOOPBACK_MS:g}\n"), encoding="utf-8")
        questions = await lines_of_input()
        tell("ready")
        while await questions.readline():
            tell(json.dumps(spans))


if __name__ == "__main__":
    asyncio.run(_controller(Path(sys.argv[2]), int(sys.argv[3])))
