"""What the first day asks of a person, and what it shows: one protocol for the screen and the tests."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.operator import Choice
from brushloop.sessions.disk import number

Picture = NDArray[np.uint8]
"""(h, w) gray or (h, w, 3) BGR."""

TargetKind = Literal[
    "pin",
    "upright",
    "board-corner",
    "sheet-corner",
    "well",
    "well-rim",
    "wash-pot",
    "wash-rim",
    "park",
    "hold-board",
    "push-sensor",
    "clear-view",
]


@dataclass(frozen=True, slots=True)
class Target:
    """A physical thing that a person brings the tip to, or does something with."""

    kind: TargetKind
    index: int = 0
    """Which one, from 0: direction of the pin, turn of the wrist of an upright brush, pose of a held board."""
    corner: str = ""
    """Which corner: `lower left`, `lower right`, `upper right` or `upper left`, as the print names it."""


class Brought(StrEnum):
    """How a person answered a request to bring the tip to a thing."""

    DONE = "done"
    SKIP = "skip"
    """Go on without it; only where the question allows it."""
    JOG = "jog"
    """Bring it there by keys; only where the question allows it."""


@dataclass(frozen=True, slots=True)
class JogView:
    """Where the tip is while a person jogs it by keys."""

    moved_mm: tuple[float, float, float]
    """From where the jog began, along the axes of the base frame."""
    steps_mm: tuple[float, ...]
    """Sizes of a step that are allowed, smallest first."""
    refused: str = ""
    """Why the last step was not made; empty if it was."""


@dataclass(frozen=True, slots=True)
class JogStep:
    """One step along an axis of the base frame."""

    axis: Literal["x", "y", "z"]
    mm: float


Answer = str | float | Brought | JogStep
"""Key of a choice or a line of text, a number, how a thing was brought, or a step of a jog (DONE ends it)."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question that a step waits for."""

    kind: Literal["choose", "number", "text", "bring", "jog"]
    text: str
    choices: tuple[Choice, ...] = ()
    default: str = ""
    """Key of a choice, or what an empty line stands for; empty if an empty line is no answer."""
    unit: str = ""
    low: float = 0.0
    high: float = 0.0
    """Range of a number."""
    target: Target | None = None
    """What the tip is to be brought to."""
    may_jog: bool = False
    """Whether it may also be brought there by keys: the arm was armed."""
    may_skip: bool = False
    """Whether the step can go on without it, or can say what to do where it is out of reach."""
    jog: JogView | None = None
    number: int = 0
    """From 1, set by a screen: an answer to an older question is dropped."""


Tone = Literal["finding", "warning", "trouble", "progress"]


@dataclass(frozen=True, slots=True)
class Shown:
    """Something found, for the person to read and look at."""

    lines: tuple[str, ...]
    picture: Picture | None = None
    tone: Tone = "finding"
    """After a warning the step can go on; trouble ends it, and its last line says what to do. Progress describes the
    current work and need not be kept."""


@dataclass(frozen=True, slots=True)
class StepState:
    """One line of the overview of all steps."""

    name: str
    """As `brushloop rig teach NAME` takes it."""
    title: str
    minutes: int
    """How long it takes a careful person."""
    state: Literal["open", "current", "taught"]
    summary: str = ""
    """What was taught, in a few words."""


def number_in(line: str, unit: str, low: float, high: float) -> float:
    """The number that a person typed, with a point or a comma. Raises ValueError, worded for that person."""
    try:
        value = number(line.replace(",", "."))
    except ValueError:
        raise ValueError(f"{line!r} is not a number") from None
    if not low <= value <= high:
        raise ValueError(f"{value:g} is outside {low:g} to {high:g} {unit}")
    return value


class LeftOff(Exception):
    """The person ended the session in the middle; everything taught so far is kept."""


class WentBack(Exception):
    """The person wants to go back one question: what was answered before this one is taken back, and asked again."""


class Guide(Protocol):
    """A person at the rig."""

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        """Show which steps are taught and which one is current; called whenever that changes."""
        ...

    async def show(self, what: Shown) -> None:
        """Show a finding."""
        ...

    async def ask(self, question: Question) -> Answer:
        """Wait for the answer, which is one that the question allows. Raises `WentBack` and `LeftOff`."""
        ...
