"""Targets that an arm was sent, held against the list that a plan checks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.motion import Move, Path, Region, Segment, over_sheet_move, photograph_moves
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.paper import to_paper
from brushloop.collect.walk import StepMoves
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance
from brushloop.drivers.sim.motion import MotionQueue

SAME_MM, SAME_DEG = 1e-6, 1e-4


def noting(motion: MotionQueue, note: Callable[[Pose], None]) -> None:
    """Tell `note` of every line that reaches the arm's queue from now on, whatever sent it."""
    add = motion.add

    def noted(target: Pose, *pace: float, **more: Any) -> bool:
        note(target)
        return add(target, *pace, **more)

    motion.add = noted  # type: ignore[method-assign]


def same(a: Pose, b: Pose) -> bool:
    travel_mm, turn_deg = distance(a, b)
    return travel_mm < SAME_MM and turn_deg < SAME_DEG


def within(config: RigConfig, pose: Pose, part: Segment) -> bool:
    """Whether a plan that checked `part` has checked this pose."""
    match part:
        case Move():
            return same(pose, part.target)
        case Region():
            corners = np.array([on_paper(config, one) for one in part.poses])
            at = on_paper(config, pose)
            inside = (corners.min(axis=0) - SAME_MM <= at) & (at <= corners.max(axis=0) + SAME_MM)
            return bool(inside.all()) and distance(pose, part.poses[0])[1] < SAME_DEG
        case Path():
            return any(same(pose, one) for one in part.poses)


def on_paper(config: RigConfig, pose: Pose) -> NDArray[np.float64]:
    return np.array([*to_paper(config.paper, pose.x_mm, pose.y_mm), pose.z_mm])


def not_checked(config: RigConfig, sent: Iterable[Pose], parts: Sequence[Segment]) -> list[Pose]:
    """What was sent though no plan has checked it; to photograph the sheet is always allowed."""
    allowed = [*parts, *photograph_moves(config)]
    return [pose for pose in sent if not any(within(config, pose, part) for part in allowed)]


def not_sent(config: RigConfig, planned: StepMoves, sent: Sequence[Pose]) -> list[Pose]:
    """What was checked though it was not sent, where no touch decides by itself. An arm that is over the sheet already
    does not go there to be seen."""
    over_sheet = over_sheet_move(config)
    fixed: list[Segment] = [part for part in planned.segments if not isinstance(part, Region) and part != over_sheet]
    return [pose for pose, _ in StepMoves(fixed).poses if not any(same(pose, one) for one in sent)]
