"""Training the generator: `brushloop train`. Only this folder loads torch."""

from __future__ import annotations

from typing import ClassVar


class TrainingStopped(Exception):
    """Training cannot usefully continue, or was asked to stop, at `step`; the last checkpoint is complete."""

    exit_code: ClassVar[int] = 4

    def __init__(self, step: int, what: str) -> None:
        self.step = step
        super().__init__(f"step {step}: {what}")
