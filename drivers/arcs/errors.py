"""Errors that only an arm under ARCS has.

MotionError
 +-- WrongOperationalMode   the pendant's mode switch is not on Automatic
 +-- MotionRefused
 |    +-- QueueFull         somebody else fills the controller's queue
 +-- MotionFailed
      +-- OutOfReach        accepted, then failed in planning: messages 30047 and 30048
"""

from __future__ import annotations

from drivers.errors import MotionError, MotionFailed, MotionRefused


class WrongOperationalMode(MotionError):
    """The operational mode is not one that a program may move the arm in; `mode` is the controller's word for it."""

    def __init__(self, device: str, op: str, mode: str) -> None:
        self.mode = mode
        super().__init__(
            device,
            op,
            f"operational mode is {mode}",
            condition="Nothing was set or powered.",
            remedy="Turn it to Automatic on the pendant; nothing here does that for you.",
        )


class QueueFull(MotionRefused):
    """The controller's queue has no room, although this driver queues few lines and waits."""


class OutOfReach(MotionFailed):
    """The controller accepted a target and could not plan a way to it; `code` is its message."""

    def __init__(self, device: str, op: str, code: int, name: str) -> None:
        self.code = code
        super().__init__(
            device,
            op,
            f"the controller reports {code} ({name})",
            condition="The arm was told to stop.",
            remedy="Bring the target within reach: move the sheet or turn the brush, then teach again.",
        )
