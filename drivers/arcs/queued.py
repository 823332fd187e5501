"""Lines that the controller carries out by itself: it has all of them before the first begins.

A program that dies in mid-press must not leave the brush down, so the lift is queued before the descent begins. The
controller holds its path meanwhile (`stopMove`) and is let go by one request (`startMove`): up to that one nothing
moves, and after it nothing more has to come from here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.arcs.controller import Controller
from drivers.arcs.rpc import DEVICE
from drivers.arcs.waiting import Tolerance, planned_s
from drivers.errors import MotionFailed
from drivers.limits import Limits
from drivers.samples import Pose, QueuedLine


def capped(
    start: Pose, lines: Sequence[QueuedLine], limits: Limits, acc_mm_s2: float
) -> tuple[list[QueuedLine], float]:
    """The lines, each as slow as its turn of the tool asks for, and an upper estimate of how long they take, in s."""
    made: list[QueuedLine] = []
    seconds, before = 0.0, start
    for line in lines:
        speed_mm_s = limits.turn_capped(before, line.target, line.speed_mm_s)
        made.append(QueuedLine(line.target, speed_mm_s, line.least_s))
        seconds += max(planned_s(before, line.target, speed_mm_s, acc_mm_s2), line.least_s)
        before = line.target
    return made, seconds


async def queue_all(
    controller: Controller,
    start: Pose,
    lines: Sequence[QueuedLine],
    acc_mm_s2: float,
    *,
    stopped: Callable[[], bool],
    tolerance: Tolerance,
) -> None:
    """Queue every line on an arm that rests at `start`, then let it begin; returns once it may have begun.

    Raises `RobotNotSafe`, `MotionRefused`, and `MotionFailed` where the arm was stopped meanwhile, or where the
    controller does not hold all lines: then the arm is not let go.
    """

    def require_not_stopped() -> None:
        # Looked at before every request, with nothing awaited between: after a stop none may follow.
        if stopped():
            raise _not_begun("the arm was told to stop")

    await controller.require_safe("moveLine")
    require_not_stopped()
    await controller.hold_path()
    for line in lines:
        require_not_stopped()
        await controller.move_line(line.target, line.speed_mm_s, acc_mm_s2, least_s=line.least_s)
    _, size = await controller.queue()
    rests = tolerance.holds(await controller.pose(), start)
    if size < len(lines):
        raise _not_begun(f"the controller holds {size} of {len(lines)} lines")
    if not rests:
        raise _not_begun("the controller does not hold its path: the arm moved before it was let go")
    require_not_stopped()
    await controller.go_on()


def _not_begun(why: str) -> MotionFailed:
    return MotionFailed(
        DEVICE,
        "sequence",
        f"{why}; the brush was not to go down before its lift was queued",
        condition="The arm was told to stop.",
        remedy="Close other clients of the controller. See docs/decisions/0014-the-controller-lifts.md.",
    )
