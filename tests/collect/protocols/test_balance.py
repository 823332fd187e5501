"""Balanced over the sheet: every (H, alpha) lies in each third of rows and columns as often as its share asks."""

from __future__ import annotations

from collections import defaultdict

import pytest

from brushloop.collect.protocols.kinds import GridConfig
from brushloop.collect.protocols.plan import Planned
from brushloop.collect.rig.paper import Layout
from brushloop.sessions.records import Condition

PAPER = {"depths_mm": [11.0, 13.0, 15.0, 17.0, 20.0], "tilts_deg": [0.0, 5.0, 10.0]}


def thirds(plan: list[Planned], layout: Layout) -> dict[Condition, list[float]]:
    """Of each (H, alpha): how many of its strokes lie in each third of rows, then of columns, less the fair number."""
    found: dict[Condition, list[float]] = defaultdict(lambda: [0.0] * 6)
    fair = [0.0] * 6
    conditions = len({s.condition for s in plan})
    for place, stroke in enumerate(plan):
        row, column = divmod(place % layout.capacity, layout.columns)
        for band in (3 * row // layout.rows, 3 + 3 * column // layout.columns):
            found[stroke.condition][band] += 1
            fair[band] += 1 / conditions
    return {key: [count - want for count, want in zip(counts, fair, strict=True)] for key, counts in found.items()}


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("layout", [Layout(6, 7), Layout(5, 9), Layout(4, 4)], ids=str)
def test_each_condition_is_within_one_or_two_strokes_of_its_share_of_every_third(seed: int, layout: Layout) -> None:
    config = GridConfig(kind="grid", **PAPER, repeats=10, seed=seed)
    balanced, plain = thirds(config.planned(layout), layout), thirds(config.planned(), layout)
    worst = max(abs(off) for offs in balanced.values() for off in offs)
    square = sum(off * off for offs in balanced.values() for off in offs)
    assert worst < 1.7
    assert square < 0.35 * sum(off * off for offs in plain.values() for off in offs)


def test_rounds_stay_whole() -> None:
    plan = GridConfig(kind="grid", **PAPER, repeats=4).planned(Layout(6, 7))
    for first in range(0, len(plan), 15):
        assert len({s.condition for s in plan[first : first + 15]}) == 15


def test_another_seed_is_another_order() -> None:
    plans = [GridConfig(kind="grid", **PAPER, repeats=2, seed=seed).planned(Layout(6, 7)) for seed in (1, 2)]
    assert [s.stroke_id for s in plans[0]] != [s.stroke_id for s in plans[1]]


@pytest.mark.parametrize("layout", [Layout(1, 1), Layout(0, 0), Layout(1, 50)], ids=str)
def test_a_sheet_without_thirds_is_no_trouble(layout: Layout) -> None:
    plan = GridConfig(kind="grid", **PAPER, repeats=2).planned(layout)
    assert len({s.stroke_id for s in plan}) == 30
