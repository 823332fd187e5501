"""Errors of training.

TrainError              a file or a setting cannot be used; nothing half-written is left
TrainingStopped         the training cannot usefully continue
 +-- BlankOutput        the generator draws nothing, or ink everywhere, for all inputs
 +-- Diverged           the loss became NaN or infinite
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar


class TrainError(Exception):
    """A checkpoint, a configuration or a set of captures that cannot be used."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path | str, what: str) -> None:
        self.path = str(path)
        self.what = what
        super().__init__(f"{path}: {what}")


class TrainingStopped(Exception):
    """Training stopped at `step`; the last checkpoint is complete."""

    exit_code: ClassVar[int] = 4

    def __init__(self, step: int, what: str) -> None:
        self.step = step
        super().__init__(f"step {step}: {what}")


class BlankOutput(TrainingStopped):
    """The images drawn at validation hold hardly any ink, or are nearly full of it, unlike their targets."""

    def __init__(self, step: int, ink_share: float, target_share: float) -> None:
        self.ink_share = ink_share
        self.target_share = target_share
        super().__init__(
            step,
            f"the generator draws {ink_share:.2%} ink where the targets hold {target_share:.2%}; "
            "train again in a new folder with a smaller learning_rate or a larger ink_weight",
        )


class Diverged(TrainingStopped):
    """The loss became NaN or infinite."""

    def __init__(self, step: int) -> None:
        super().__init__(step, "the loss is no longer a number; train again with a smaller learning_rate")
