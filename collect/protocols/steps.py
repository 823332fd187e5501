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
"""JSON-able: it goes into the journal and comes back from there."""


class StepKind(StrEnum):
    """What a step does."""

    ZERO_TOUCH = "zero_touch"
    BOARD = "board"
    DIP = "dip"
    PRESS = "press"
    DRAW = "draw"
    """A figure: all strokes of one character, on one cell. Cut anywhere, the whole of it is done again."""
    TOUCH = "touch"
    """Bring the tip down on a named point of the sheet and tell how high it lies there."""
    CAPTURE = "capture"
    CHOOSE = "choose"
    """Fit the brush to what is captured, and choose the next press or to stop; nothing moves."""
    REVIEW = "review"
    """Read which captures a person has marked bad since the strokes were made; nothing moves."""
    SELF_CHECK = "self_check"
    """An uneven triangle of marks that a mirrored, turned or stretched rig does not reproduce."""


MARKING = frozenset({StepKind.PRESS, StepKind.DRAW, StepKind.SELF_CHECK})
"""They leave ink on a paper cell of their own."""
RUN_SCOPED = frozenset({StepKind.ZERO_TOUCH})
"""Done again in every process: what they establish does not outlive it."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step. `index` tells equal steps of one protocol apart."""

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
        """True where a stored result must not stand in for doing it."""
        return self.kind in RUN_SCOPED


Protocol = Generator[Step, Result, None]
"""Yields steps and is sent their results, so that later steps can depend on earlier ones."""
KNOWING = frozenset({StepKind.ZERO_TOUCH, StepKind.TOUCH, StepKind.BOARD})
"""Paper and board must be known before it."""


def with_self_check(protocol: Protocol) -> Protocol:
    """The same protocol, with a SELF_CHECK step before the first that is for a mark."""
    step = next(protocol)
    checked = False
    with contextlib.suppress(StopIteration):
        while True:
            if not checked and step.kind not in KNOWING:
                yield Step(StepKind.SELF_CHECK, 0)
                checked = True
            step = protocol.send((yield step))
