"""The steps of a set-up as a screen lists them: plain values, quick to import."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from collect.protocols.steps import StepKind

SET_UP = (StepKind.BOARD, StepKind.ZERO_TOUCH, StepKind.SELF_CHECK)
TITLES = {
    StepKind.BOARD: "Camera, board, scale",
    StepKind.ZERO_TOUCH: "Zero touch and plane",
    StepKind.SELF_CHECK: "Self-check",
}


class Standing(StrEnum):
    """How far a set-up step is."""

    TO_COME = "to come"
    NOW = "now"
    GOOD = "good"
    DOUBTFUL = "look"
    """Measured, and outside what it should be."""


@dataclass(frozen=True, slots=True)
class Fact:
    """One thing that was measured."""

    name: str
    value: str
    limit: str = ""
    good: bool | None = None
    """None where there is no limit."""


@dataclass(frozen=True, slots=True)
class SetUpStep:
    """One step of the set-up, as a screen lists it."""

    kind: StepKind
    standing: Standing
    facts: tuple[Fact, ...] = ()

    @property
    def title(self) -> str:
        """What it is about."""
        return TITLES[self.kind]
