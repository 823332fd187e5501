"""The order of a plan: rounds, shuffled or as written, balanced where the sheet is known."""

from __future__ import annotations

import random
from dataclasses import replace

from collect.protocols.balance import balanced
from collect.protocols.planned import Planned
from collect.rig.paper import Layout


def numbered(rounds: list[list[Planned]], seed: int | None, layout: Layout | None) -> list[Planned]:
    """The rounds one after the other, every stroke numbered; then, for a seed and a layout, balanced over the sheet."""
    index = 0
    for strokes in rounds:
        for k, stroke in enumerate(strokes):
            strokes[k] = replace(stroke, index=index)
            index += 1
    if seed is not None and layout is not None and layout.capacity > 0:
        conditions = [[(s.height_mm, s.tilt_deg) for s in strokes] for strokes in rounds]
        orders = balanced(conditions, layout, seed)
        rounds = [[strokes[i] for i in order] for strokes, order in zip(rounds, orders, strict=True)]
    return [stroke for strokes in rounds for stroke in strokes]


def shuffled(rounds: list[list[Planned]], seed: int | None) -> list[list[Planned]]:
    """Each round in an order of its own; as it is without a seed."""
    if seed is not None:
        rng = random.Random(seed)
        for strokes in rounds:
            rng.shuffle(strokes)
    return rounds
