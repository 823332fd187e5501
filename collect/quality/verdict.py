"""The result of a quality check: a number, its limit, and what an operator should do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Family(StrEnum):
    """What a failure makes useless, and therefore what must be done again."""

    PICTURE = "picture"
    """The photograph, not the stroke: remove the cause and photograph again; the stroke on paper may be sound."""
    PLACE = "place"
    """The ink is not where it belongs: press on a new patch."""
    INK = "ink"
    """Too little ink: dip again and press on a new patch."""
    SHAPE = "shape"
    """The hairs lay badly: comb or wipe the brush, dip, and press on a new patch."""


class Failure(StrEnum):
    """The failures in the order in which they are judged; the first that is found is the cause.

    A stroke can be judged only in a sound picture and once it is distinguished from other ink; its place and tone,
    only if the hairs carried ink; its shape comes last.
    """

    family: Family
    """What it makes useless."""

    def __new__(cls, value: str, family: Family) -> Failure:
        """Make a member that equals its text and carries its family."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.family = family
        return member

    EXPOSURE = "exposure", Family.PICTURE
    BLURRED = "blurred", Family.PICTURE
    CUT = "cut", Family.PICTURE
    GLARE = "glare", Family.PICTURE
    NEIGHBOUR = "neighbour", Family.PLACE
    BLANK = "blank", Family.INK
    DRY = "dry", Family.INK
    SMEARED = "smeared", Family.PLACE
    MISPLACED = "misplaced", Family.PLACE
    FAINT = "faint", Family.INK
    SPLIT = "split", Family.SHAPE
    BENT = "bent", Family.SHAPE


@dataclass(frozen=True, slots=True)
class Check:
    """One measured property of a capture."""

    name: Failure
    score: float
    unit: str
    threshold: float
    passed: bool
    reason: str
    """What is wrong and what to do about it; empty where it passed."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """All checks of one capture that could be measured, in the order of `Failure`."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether the capture is sound."""
        return self.cause is None

    @property
    def cause(self) -> Check | None:
        """The dominant failure: the first in the order of `Failure`; None where all passed."""
        return next((check for check in self.checks if not check.passed), None)

    @property
    def reason(self) -> str:
        """The cause's reason, with the other failures named; empty where all passed."""
        failed = [check for check in self.checks if not check.passed]
        if not failed:
            return ""
        others = f" Also: {', '.join(check.name for check in failed[1:])}." if failed[1:] else ""
        return failed[0].reason + others
