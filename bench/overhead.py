"""`bench overhead`: what a stroke takes, a session at the rig's real speed, taken apart.

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
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import brushloop
from bench.brushes import DEPTHS_MM
from bench.harness import BenchError, Result, at_most, lines_of_input, machine, rounds_of, started, tell

DWELL_S = 0.2
GOAL_PERCENT, MOTION_GOAL_S = 2.0, 15.0
STEPS = ("dip", "press", "capture")
"""The steps of a stroke."""
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


def run(*, n: int | None = None, seed: int = 0) -> list[Result]:
    """The motion of a stroke, by step; software time of `n` strokes (4) as a share of it, in all and by what it is.

    The conditions of a step's motion list its moves. Takes about half a minute a stroke.
    """
    strokes = rounds_of(n, 4)
    spans: Spans = defaultdict(list)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        with started("bench.overhead", "controller", str(folder / "rig.toml"), str(seed)) as controller:
            _write_protocol(folder / "protocol.toml", strokes, seed)
            with _watching(spans):
                _collect(folder)
            spans["motion"] = [(begin_s, end_s) for begin_s, end_s in json.loads(controller.ask())]
    if len(spans["press"]) != strokes:
        raise BenchError("a press was cut; the figures would cover two attempts")
    return _results(spans, strokes, seed)


def _results(spans: Spans, strokes: int, seed: int) -> list[Result]:
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
    where = f"loopback rig at its real speed, {motion_s:.1f} s of motion a stroke, dwell left out; {machine()}"

    def percent(name: str, seconds: float) -> Result:
        value = 100.0 * seconds / motion_s
        return at_most(f"overhead: {name}", value, "% of motion", GOAL_PERCENT, strokes, seed, where)

    def part(name: str, seconds: float, unit: str) -> Result:
        peer = "the motion of one stroke"
        return Result(f"overhead: {name}", 1e3 * seconds, unit, peer, motion_s / seconds, strokes, seed, where)

    results = [
        at_most("overhead: motion", motion_s, "s a stroke", MOTION_GOAL_S, strokes, seed, where),
        *(_motion_of(spans, step, motion_s, strokes, seed) for step in STEPS),
        percent("software", all_s - waits_s),
        percent("software and waits for devices", all_s),
    ]
    for name, seconds in sorted(took.items(), key=lambda item: -item[1]):
        if 1e3 * seconds / strokes >= LEAST_MS:
            results.append(part(name, seconds / strokes, f"ms a stroke{', waited' if name in WAITS else ''}"))
    if 1e3 * once_s >= LEAST_MS:
        results.append(part(BLANK, once_s, "ms a sheet"))
    return results


def _motion_of(spans: Spans, step: str, motion_s: float, strokes: int, seed: int) -> Result:
    """Seconds of motion of one kind of step a stroke; the conditions name what each of its moves takes."""
    moves: dict[int, list[float]] = defaultdict(list)
    for begin_s, end_s in spans[step]:
        inside = [(a, b) for a, b in spans["motion"] if begin_s <= a < end_s]
        for number, (a, b) in enumerate(inside, 1):
            moves[number].append(b - a)
    each = ", ".join(f"move {number} {sum(taken) / strokes:.2f} s" for number, taken in sorted(moves.items()))
    seconds = sum(itertools.chain.from_iterable(moves.values())) / strokes
    peer, where = "the motion of one stroke", f"{each}; {machine()}"
    return Result(f"overhead: motion of {step}", seconds, "s a stroke", peer, motion_s / seconds, strokes, seed, where)


def share_out(spans: Spans, begin_s: float, end_s: float) -> dict[str, float]:
    """Seconds of [begin, end] by part; an instant that no part covers is `the rest`."""
    from brushloop.drivers.sim.motion import STEADY_LAG_S

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
    try:
        brushloop.collect_session(folder / "rig.toml", folder / "protocol.toml", folder / "sessions")
    except brushloop.CollectAborted as error:
        raise BenchError(f"the session failed: {error}") from error


@contextlib.contextmanager
def _watching(spans: Spans) -> Iterator[None]:
    """Note when each part begins and ends."""
    from brushloop.collect.engine import capture as capturing
    from brushloop.collect.engine.recorder import Recorder
    from brushloop.collect.engine.run import Run
    from brushloop.drivers.arcs.robot import AuboArcs
    from brushloop.drivers.camera import OpenCvCamera
    from brushloop.drivers.ink.station import InkStation
    from brushloop.sessions.store import SessionStore

    def noted(function: Callable[..., Any], part: str | None) -> Callable[..., Any]:
        async def later(*arguments: Any, **options: Any) -> Any:
            begin_s = time.monotonic()
            try:
                return await function(*arguments, **options)
            finally:
                spans[part or str(arguments[1].kind)].append((begin_s, time.monotonic()))

        def at_once(*arguments: Any, **options: Any) -> Any:
            begin_s = time.monotonic()
            try:
                return function(*arguments, **options)
            finally:
                assert part is not None
                spans[part].append((begin_s, time.monotonic()))

        return later if asyncio.iscoroutinefunction(function) else at_once

    watched: list[tuple[Any, str, str | None]] = [
        (Run, "perform", None),  # by the kind of its step
        (AuboArcs, "follow", "move"),
        (OpenCvCamera, "fresh", FRAME),
        (InkStation, "replenish", INK),
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
    depths_mm = list(DEPTHS_MM[:strokes])
    repeats = -(-strokes // len(depths_mm))
    if repeats * len(depths_mm) != strokes:
        raise ValueError(f"n = {strokes}: up to {len(DEPTHS_MM)}, or a multiple of it")
    text = f'kind = "grid"\ndepths_mm = {depths_mm}\ntilts_deg = [5.0]\nrepeats = {repeats}\n'
    path.write_text(f"{text}dwell_s = {DWELL_S}\nseed = {seed}\n", encoding="utf-8")


async def _controller(path: Path, seed: int) -> None:
    """Serves the rig; each line on the input is answered with the spans of time in which the arm moved."""
    from brushloop.drivers.sim.config import SimConfig
    from brushloop.drivers.sim.rig import LoopbackRig

    async with LoopbackRig(SimConfig(seed=seed + 1)) as rig:
        queue, clock = rig.world.motion, rig.world.clock
        queue.rests = deque()  # all of them
        # The rig and what collects share the cores with whatever else runs here, and a sensor's thread that has to wait
        # for one falls silent. No brush is in danger: the longest silence that the loopback bus may have is allowed.
        text = rig.toml()
        assert SILENCE in text, "the rig does not limit the silence of its force sensor as expected"
        path.write_text(text.replace(SILENCE, "stale_ms = 2000\n"), encoding="utf-8")
        questions = await lines_of_input()
        tell("ready")
        while await questions.readline():
            # At rate 1 the rig's clock and the monotonic one, which all processes share, differ by a constant.
            shift_s = time.monotonic() - clock.now_s()
            spans: list[Span] = [(rest.left_s + shift_s, rest.at_s + shift_s) for rest in queue.rests]
            tell(json.dumps(spans))


if __name__ == "__main__":
    asyncio.run(_controller(Path(sys.argv[2]), int(sys.argv[3])))
