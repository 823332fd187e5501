"""When the brush left the ink, when it then came to the paper, and whether that was as with the other strokes."""

from __future__ import annotations

import asyncio
from collections.abc import Generator
from contextlib import contextmanager

from collect.engine.steps.context import StepContext
from collect.motion.procedures import TOUCH_TOLERANCE_MM, Move
from drivers.samples import PoseSample
from sessions.history import limit_s, unlike, waits_of
from sessions.recording.schemas import Check

STALE_INK_S = 5.0
"""A brush that waited longer for its press to begin dips again: a pause, a question, a photograph in between."""


class DipToTouch:
    """Waits of one step: a stroke of its own, or a figure that may dip between its strokes."""

    def __init__(self, context: StepContext) -> None:
        self._context = context
        self._left_ns: int | None = None
        self._waits_s: list[float] = []

    @property
    def longest_s(self) -> float | None:
        """None where no pose told of the brush on the paper."""
        return max(self._waits_s, default=None)

    @contextmanager
    def watching(self) -> Generator[DipToTouch]:
        """Look at every pose, within the block."""
        with self._context.recorder.also(self._pose):
            yield self

    async def begin(self, first: Move) -> None:
        """After a dip: over the place, and wait there where the protocol asks for it."""
        run = self._context.run
        left_ns, run.known.left_ink_ns = run.known.left_ink_ns, None
        assert left_ns is not None
        if (wait_s := run.protocol.wait_after_dip_s) is not None:
            await run.procedures.go(first)
            left_s = wait_s - (run.rig.clock.now_ns() - left_ns) / 1e9
            with run.progress.meanwhile(f"wait with the ink, {wait_s:g} s from the dip"):
                await asyncio.sleep(max(left_s, 0.0))
        self._left_ns = left_ns

    def _pose(self, sample: PoseSample) -> None:
        """The first pose on the paper counts; the step's moves come down nowhere else in between."""
        if self._left_ns is None:
            return
        procedures, paper = self._context.run.procedures, self._context.run.rig.config.paper
        if procedures.plane.above_mm(paper, sample.pose) <= TOUCH_TOLERANCE_MM:
            self._waits_s.append((sample.stamp.host_ns - self._left_ns) / 1e9)
            self._left_ns = None


def stale(context: StepContext) -> bool:
    """Whether the brush must dip before it may press: it has no ink that is known of, or that waited too long."""
    left_ns = context.run.known.left_ink_ns
    return left_ns is None or context.run.rig.clock.now_ns() - left_ns > STALE_INK_S * 1e9


def wait_check(context: StepContext) -> Check | None:
    """Of a CAPTURE step: the wait of the stroke that it shows, held against those before. A remark, never a verdict:
    the ink is judged by how it looks. None where no wait was recorded."""
    still, stroke_id = context.attempt.serial, context.step.params["stroke_id"]
    this = {"kind": "capture", "result": {"stroke_id": stroke_id, "still": still}}
    waits = waits_of([*context.run.store.state.segments, this])
    if still not in waits:
        return None
    reason, found = unlike(waits).get(still, ""), limit_s(waits.values())
    threshold = None if found is None else sum(found)
    return Check(name="dip_to_touch", score=waits[still], threshold=threshold, passed=not reason, reason=reason)
