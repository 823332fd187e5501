"""An engine of frozen snapshots: shows what it is handed and notes what it is asked."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

from collect.errors import CollectAborted
from collect.snapshot import CellCount, Snapshot
from collect.states import State

HEIGHTS_MM = (11.0, 13.0, 15.0, 17.0, 20.0)
TILTS_DEG = (0.0, 5.0, 10.0)
ERROR = (
    "aubo-arcs: move: protective stop: joint 4 torque 31.2 N m above 28.0 N m. "
    "The arm stands where it stopped; the brush may be on the paper.\n"
    "Release the stop at the pendant, then run the same command again: it begins with a retreat."
)


def grid_of(done: int, heights: tuple[float, ...] = HEIGHTS_MM) -> tuple[CellCount, ...]:
    places = [(h, a) for h in heights for a in TILTS_DEG]
    return tuple(CellCount(h, a, min(max(done - 2 * n, 0), 2), 2) for n, (h, a) in enumerate(places))


def picture(**changes: Any) -> Snapshot:
    """A run in its middle, with what differs."""
    running = Snapshot(
        session_id="2026-11-21-grid-01",
        source="loopback rig",
        state=State.RUNNING,
        step="press H 15 mm, alpha 5 deg on cell 13",
        strokes_done=13,
        strokes_planned=30,
        grid=grid_of(13),
        voids=1,
        elapsed_s=185.0,
        eta_s=242.0,
        tip_mm=(123.4, -45.25, 12.0),
        messages=("session: 2026-11-21-grid-01", *(f"capture {n}: blob 212 mm2, sharp" for n in range(1, 14))),
        error="",
    )
    return replace(running, **changes)


PAUSED = picture(state=State.PAUSED, step="paused", tip_mm=None)
FAILED = picture(state=State.FAILED, error=ERROR, messages=("capture 13: blob 212 mm2, sharp", f"warning: {ERROR}"))
DONE = picture(state=State.DONE, step="merge and verify", strokes_done=30, grid=grid_of(30), eta_s=0.0)


class FakeEngine:
    """`RunnableEngine` without an arm; a stop leads straight to stopped."""

    def __init__(self, now: Snapshot) -> None:
        self.now = now
        self.calls: list[str] = []
        self.looks = 0
        self._over = threading.Event()

    def snapshot(self) -> Snapshot:
        self.looks += 1
        return self.now

    def pause(self) -> None:
        self.calls.append("pause")

    def resume(self) -> None:
        self.calls.append("resume")

    def answer(self, number: int, key: str) -> bool:
        self.calls.append(f"answer {number} {key}")
        return True

    def stop(self) -> None:
        self.calls.append("stop")
        self._over.set()

    def start(self) -> None:
        self.calls.append("start")

    @property
    def finished(self) -> bool:
        return self._over.is_set()

    def join(self) -> None:
        self.calls.append("join")
        assert self._over.wait(5.0)
        raise CollectAborted("stopped; the same command goes on from here")
