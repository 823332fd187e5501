"""Steps: the units of a protocol and of resume."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Generator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

Value = float | int | str | bool | None
Params = dict[str, Value]
Result = dict[str, Any]
"""Must be valid JSON: it is written to the journal and read back."""


class StepKind(StrEnum):
    """What a step does."""

    ZERO_TOUCH = "zero_touch"
    BOARD = "board"
    DIP = "dip"
    PRESS = "press"
    DRAW = "draw"
    """A figure: all strokes of one character, on one patch. If it is interrupted, all of it is done again."""
    TOUCH = "touch"
    """Bring the tip down on a given point of the sheet and measure its height."""
    CAPTURE = "capture"
    REVIEW = "review"
    """Read which captures a person has marked bad; nothing moves."""
    SELF_CHECK = "self_check"
    """Press an uneven triangle of marks, which a mirrored, turned or stretched rig does not reproduce."""


MARKING = frozenset({StepKind.PRESS, StepKind.DRAW, StepKind.SELF_CHECK})
"""Steps that leave ink on a paper patch of their own."""
RUN_SCOPED = frozenset({StepKind.ZERO_TOUCH, StepKind.BOARD})
"""Steps whose first one every process does again: it finds the paper, and sees whether camera or board moved."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step. `index` distinguishes equal steps of one protocol."""

    kind: StepKind
    index: int
    params: Params = field(default_factory=dict[str, Value])

    @property
    def key(self) -> str:
        """Stable across processes: sha256 of kind, params and index."""
        text = json.dumps([self.kind, self.params, self.index], sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def run_scoped(self) -> bool:
        """Whether every process must do the step again, even if a stored result exists."""
        return self.kind in RUN_SCOPED and self.index == 0


Protocol = Generator[Step, Result, None]
"""Yields steps and is sent their results, so that later steps can depend on earlier ones."""
KNOWING = frozenset({StepKind.ZERO_TOUCH, StepKind.TOUCH, StepKind.BOARD})
"""Steps that come before the self-check, which needs paper and board."""


def with_self_check(protocol: Protocol) -> Protocol:
    """The same protocol, with a SELF_CHECK step before the first one that prepares a mark."""
    step = next(protocol)
    checked = False
    with contextlib.suppress(StopIteration):
        while True:
            if not checked and step.kind not in KNOWING:
                yield Step(StepKind.SELF_CHECK, 0)
                checked = True
            step = protocol.send((yield step))
