"""What a person marks bad while the session is open is pressed again once the plan is through."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from collect.protocols.planned import Planned
from collect.protocols.steps import Result

AGAIN = "-again"


def made_again(marked: Planned, index: int) -> Planned:
    """The same press under a name of its own: both are in the recording, and the first stays marked."""
    return replace(marked, stroke_id=f"{marked.stroke_id}{AGAIN}", index=index)


def with_review(plan: Iterable[Planned], reviewed: Result) -> list[Planned]:
    """The plan after a REVIEW step: each marked stroke gives its place to the one that is made again.

    `reviewed` holds `again`: [stroke_id, index] of each.
    """
    indices = {str(stroke_id): int(index) for stroke_id, index in reviewed["again"]}
    return [made_again(p, indices[p.stroke_id]) if p.stroke_id in indices else p for p in plan]
