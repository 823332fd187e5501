"""Faults for a simulated instrument without a rig."""

from __future__ import annotations

from brushloop.drivers.force.simulator import ForceBoard
from brushloop.drivers.ink.simulator import PtyLine


def fail_rounds(board: ForceBoard, *faults: str) -> None:
    """Apply these faults to the board's next rounds, one each."""
    coming = iter(faults)
    board.next_fault = lambda: next(coming, None)


def fail_requests(line: PtyLine, *faults: str) -> None:
    """Apply these faults to the next requests on the line, one each."""
    coming = iter(faults)
    line.next_fault = lambda: next(coming, None)
